"""Manage the contacts of a node, and find the nodes closest to an id (Kademlia, sections 2.2 to 2.4).

A contact is added only after it has proved its key in an answer from its address.  A record is stored at the k live
nodes closest to its key.  A node that knows all members of its team (``members``) determines these nodes without a
search; in a larger network iterative lookups find them.
"""

from __future__ import annotations

import random
from collections import deque
from collections.abc import Callable, Iterable
from functools import cached_property
from typing import Any, NamedTuple

from twisted.internet.defer import Deferred
from twisted.internet.interfaces import IReactorTime

from middleware.entangled.background import Background
from middleware.entangled.bounded import put_bounded
from middleware.entangled.contact import Contact, parse_contact
from middleware.entangled.errors import EntangledError, NoAnswer, Refused
from middleware.entangled.kademlia.distance import select_closest
from middleware.entangled.kademlia.lookup import Lookup
from middleware.entangled.kademlia.member_table import MAX_MEMBERS, MemberTable
from middleware.entangled.kademlia.routing_table import STALE_AFTER, RoutingTable
from middleware.entangled.listeners import Listeners
from middleware.entangled.wire.congestion import RoundTrip
from middleware.entangled.wire.endpoint import Endpoint

K = 8
ALPHA = 3
CHECK_INTERVAL_S = 4.0
"""The seconds before this node pings an unknown node, or a contact at a new address, again to authenticate it."""
MISS_INTERVAL_S = 0.5
"""The seconds in which several unanswered requests are counted as one miss, because the loss of a burst of requests is
not evidence of a failed node.
"""
RECORD_INTERVAL_S = 0.1
"""The seconds after a recorded datagram of a contact during which further datagrams are not recorded."""
INITIAL_HEDGE_S, MAX_HEDGE_S = 0.01, 0.15
"""The delay of a hedged request in seconds before the first measurement, and the maximum delay.  After measurements the
delay is the time within which nearly all answers arrive."""
MIN_LOOKUP_TIMEOUT_S, MAX_LOOKUP_TIMEOUT_S, TIMEOUTS_PER_REQUEST = 0.4, 2.5, 2.6
"""The minimum and maximum timeout in seconds of a request of a lookup in a large network, and the factor by which the
timeout exceeds the initial timeout of a request.  This factor is enough for two tries; at a high loss rate the timeout
is longer."""
MAX_FOUND = 512
"""The number of keys for which the result of the last lookup is cached."""
MAX_RECORDED = 4096
"""The number of contacts for which the time of the last datagram or miss is recorded; the oldest is deleted first."""

CONTACT_WAIT_STEPS, CONTACT_WAIT_STEP_S = 15, 0.1
MEMBERS_WAIT_STEPS, MEMBERS_WAIT_STEP_S = 75, 0.02
"""The maximum number of steps for which an operation that needs a majority waits until the members are known, and the
seconds of each step."""
MAX_LOOKUP_STATS = 16


class Voters(NamedTuple):
    """The nodes among which a majority is counted; ``ids`` are the known ones, ``size`` is the number of all voters."""

    ids: frozenset[bytes]
    size: int

    @property
    def majority(self) -> int:
        """The smallest number of votes that is more than half."""
        return self.size // 2 + 1

    def count_known(self, ids: Iterable[bytes]) -> int:
        """Return the number of ``ids`` that are voters."""
        return len(self.ids.intersection(ids))


class LookupStats(NamedTuple):
    """A finished lookup: the numbers of requests, hops and contacts found, and its duration in seconds."""

    key: bytes
    asked: int
    hops: int
    found: int
    seconds: float


class Overlay:
    """The contacts of a node.

    A contact heard within the last ``max_silence`` seconds keeps its place in a full bucket without a ping.
    ``on_new_contact`` and ``on_lost`` are called with contacts that appear and disappear.  ``on_named`` is called for
    each contact that an answer contains, with this contact and the contact that sent the answer.

    ``Membership`` and ``LivenessProber`` set the following attributes.  ``has_all_members``: all members of the team
    are known.  ``is_large``: there are too many members for complete knowledge.  ``has_found_neighbours``: this node
    has looked up its neighbours, so if it knows few nodes, the network has few nodes.

    In a large network the routing table is used.  The member table then contains only contacts for which the routing
    table has no space, and only as long as this node knows few contacts.
    """

    def __init__(
        self, own_contact: Callable[[], Contact], endpoint: Endpoint, clock: IReactorTime, background: Background
    ) -> None:
        self.own_contact = own_contact
        self.own_id = own_contact().node_id
        self._endpoint = endpoint
        self._clock = clock
        self._background = background
        self.table = RoutingTable(self.own_id, K)
        self.members = MemberTable(self.own_id)
        self.has_all_members = False
        self.is_large = False
        self.has_found_neighbours = False
        self.on_new_contact = Listeners[[Contact]]()
        self.on_lost = Listeners[[Contact]]()
        self.on_named = Listeners[[Contact, Contact]]()
        self._last_received_at: dict[bytes, float] = {}
        self._round_trip = RoundTrip(INITIAL_HEDGE_S)
        self._slow: set[bytes] = set()
        self._lookup_results: dict[bytes, list[Contact]] = {}
        self._misses: dict[bytes, tuple[int, float]] = {}
        self._neighbours: list[Contact] = []
        self._neighbours_version = (-1, -1)
        self.max_silence = 0.0
        self._checked_at: dict[bytes, float] = {}
        self.lookups: deque[LookupStats] = deque(maxlen=MAX_LOOKUP_STATS)
        endpoint.on_contact.add(self.mark_authenticated)
        endpoint.expose("find_node", self._answer_find_node, early=True)

    @cached_property
    def _rng(self) -> random.Random:
        # This generator only distributes load, so its numbers may be predictable; the system generator would need a
        # system call per number.
        return random.Random(int.from_bytes(self.own_id))

    # -- placement of records ---------------------------------------------------------------------------------------

    @property
    def is_complete(self) -> bool:
        """Whether all nodes are known, so that no lookup is necessary."""
        return self.has_all_members and not self.members.is_full

    @property
    def is_sparse(self) -> bool:
        """Whether there are more nodes than this node knows, so the nodes close to a key must be looked up."""
        return not self.is_complete and (len(self.table) >= K or not self.has_found_neighbours)

    def find_responsible(self, key: bytes) -> list[Contact]:
        """Return the k live nodes closest to ``key`` that this node knows, including itself, closest first."""
        if self.is_complete:
            return self.members.closest(key, K, self.own_contact())
        known = [
            *self._lookup_results.get(key, ()),
            *self.table.closest(key),
            *self.members.list_live(),
            self.own_contact(),
        ]
        return _closest(known, key)

    def find_neighbours(self) -> list[Contact]:
        """Return the k contacts closest to this node, which store mostly the same records."""
        version = self.table.version, self.members.version
        if self._neighbours_version != version:
            self._neighbours_version, self._neighbours = version, self.find_nearest(self.own_id)
        return self._neighbours

    @property
    def is_surely_large(self) -> bool:
        """Whether this node knows so many contacts that the network is certainly large."""
        return self.members.is_full or len(self.table) + len(self.members) >= MAX_MEMBERS

    def find_possible_replicas(self, key: bytes) -> list[Contact]:
        """Return the other nodes that may store records of ``key``.

        These are the k closest known nodes, and the nodes that the last lookup found.  A bucket has only k places, so
        in a large network not all nodes that a lookup found are in the routing table.
        """
        if self.is_complete:
            return [c for c in self.find_responsible(key) if c.node_id != self.own_id]
        both = {c.node_id: c for c in [*self._lookup_results.get(key, ()), *self.find_responsible(key)]}
        return [contact for node_id, contact in both.items() if node_id != self.own_id]

    def is_responsible(self, key: bytes) -> bool:
        """Return whether this node is one of the k closest known nodes to ``key``."""
        return self.is_replica(key, self.own_contact())

    def is_replica(self, key: bytes, contact: Contact) -> bool:
        """Return whether ``contact`` is among the k closest known nodes to ``key``."""
        return any(c.node_id == contact.node_id for c in self.find_responsible(key))

    async def lookup_replicas(self, key: bytes) -> list[Contact]:
        """Return the k live nodes closest to ``key``, including this one; look them up if not all nodes are known.

        A node that is still joining waits for its first contacts.
        """
        await self._wait(
            lambda: self.has_all_members or self.is_large or len(self.members) > 0,
            CONTACT_WAIT_STEPS,
            CONTACT_WAIT_STEP_S,
        )
        if not self.is_sparse:
            self._lookup_results.pop(key, None)
            return self.find_responsible(key)
        found = await self.lookup(key)
        nearest = _closest([*found, self.own_contact()], key)
        self.cache_lookup(key, [contact for contact in nearest if contact.node_id != self.own_id])
        return nearest if len(found) >= K else self.find_responsible(key)

    async def wait_for_members(self) -> None:
        """Wait a limited time for a node that is still joining to learn the members."""
        await self._wait(lambda: self.has_all_members or self.is_large, MEMBERS_WAIT_STEPS, MEMBERS_WAIT_STEP_S)

    def cache_lookup(self, key: bytes, found: list[Contact]) -> None:
        """Cache the result of a lookup."""
        put_bounded(self._lookup_results, key, found, MAX_FOUND)

    def find_voters(self, key: bytes, targets: list[Contact]) -> Voters:
        """Return the voters for ``key`` with the replicas ``targets``.

        In a team with a member table, absent members are also voters; in a larger network the voters are the nodes that
        the lookup found.
        """
        if not (self.has_all_members or self.is_large):
            # This node has not entered its team yet: the few nodes that it knows must not be treated as the whole team.
            return Voters(frozenset([self.own_id]), 2)
        absent = [] if self.members.is_full or self.is_large else self.members.list_absent()
        ids = frozenset(contact.node_id for contact in (_closest([*targets, *absent], key) if absent else targets))
        return Voters(ids, len(ids))

    async def lookup(self, target: bytes) -> list[Contact]:
        """Return the k live nodes closest to ``target``, except this node (Kademlia, section 2.3)."""
        seeds = [
            *self.table.closest(target),
            *(self.members.closest(target, K, self.own_contact()) if len(self.members) else ()),
        ]
        lookup = Lookup(target, K, ALPHA, seeds, exclude=self.own_id)
        began = self._clock.seconds()
        self.table.record_lookup(target, began)
        hops: dict[bytes, int] = {}
        asked: list[int] = []

        async def visit(contact: Contact) -> None:
            asked.append(hops.setdefault(contact.node_id, 1))
            named = parse_contacts(await self._request_contacts(contact, target))
            for other in named:
                self.on_named(other, contact)
                hops.setdefault(other.node_id, hops[contact.node_id] + 1)
            lookup.record_answer(contact, named)

        await self.run_lookup(lookup, visit)
        found = lookup.closest()
        took = self._clock.seconds() - began
        self.lookups.append(LookupStats(target, len(asked), max(asked, default=0), len(found), took))
        return found

    async def run_lookup(
        self, lookup: Lookup, visit: Callable[[Contact], Any], is_done: Callable[[], bool] = lambda: False
    ) -> None:
        """Run ``lookup``: ask the contacts that it returns, alpha in parallel plus one for each slow contact."""
        done: Deferred[None] = Deferred()

        def step() -> None:
            if done.called:
                return
            if lookup.is_finished or is_done():
                done.callback(None)
                return
            for contact in lookup.take_next():
                self._background.fork(go(contact))

        def hedge(contact: Contact) -> None:
            self.mark_slow(contact)
            lookup.mark_slow(contact)
            step()

        async def go(contact: Contact) -> None:
            in_time = self._background.later(self.hedge_delay(), hedge, contact)
            try:
                await visit(contact)
            except EntangledError:
                lookup.record_failure(contact)
            in_time()
            step()

        step()
        await done

    # -- liveness of contacts ---------------------------------------------------------------------------------------

    async def ask(
        self,
        contact: Contact,
        method: str,
        *arguments: object,
        changes: bool = False,
        timeout: float | None = None,
        is_light: bool = False,
    ) -> Any:
        """Send a request to ``contact``; record a miss if there is no answer."""
        began = self._clock.seconds()
        has_session = self._endpoint.has_session(contact)
        try:
            answer = await self._endpoint.ask(
                contact, method, *arguments, changes=changes, timeout=timeout, is_light=is_light
            )
        except NoAnswer:
            self.record_miss(contact)
            raise
        if has_session:  # otherwise the measured time would include a handshake
            self._round_trip.add_sample(self._clock.seconds() - began)
        return answer

    async def _request_contacts(self, contact: Contact, target: bytes) -> Any:
        """Request the contacts that ``contact`` knows near ``target``.

        If a datagram of the contact arrived during an unanswered request, the request is repeated once.  The reason is
        that, when several lookups ask an unknown contact at the same moment, only one request is sent inside the
        handshake.  The requests that wait for the handshake may time out.
        """
        began = self._clock.seconds()
        try:
            return await self.ask(contact, "find_node", target, timeout=self.lookup_timeout)
        except NoAnswer:
            if self.silence(contact) >= self._clock.seconds() - began:
                raise
            return await self.ask(contact, "find_node", target, timeout=self.lookup_timeout)

    def hedge_delay(self) -> float:
        """Return the seconds after which other contacts are asked in parallel with a contact that has not answered.

        The delay is measured over all contacts, because a single contact has few and old samples.  A distant contact
        always exceeds this delay, which costs only a few more requests.
        """
        if self.is_large:  # unknown contacts need a handshake, and may be distant
            guess = self._endpoint.peers.initial_timeout
            return (
                guess if not self._round_trip.is_measured else min(guess, max(MAX_HEDGE_S, self._round_trip.nearly_all))
            )
        return min(MAX_HEDGE_S, self._round_trip.nearly_all)

    @property
    def lookup_timeout(self) -> float | None:
        """The timeout of one request of a lookup in seconds; None: the default.

        In a large network the timeout is short, because there are always alternatives and some of the returned contacts
        have failed.
        """
        if not self.is_large:
            return None
        peers = self._endpoint.peers
        return min(
            MAX_LOOKUP_TIMEOUT_S,
            max(MIN_LOOKUP_TIMEOUT_S, max(TIMEOUTS_PER_REQUEST, peers.loss.tries) * peers.initial_timeout),
        )

    def mark_slow(self, contact: Contact) -> None:
        """Record that ``contact`` exceeded the usual time; until it answers, other contacts are asked first."""
        if len(self._slow) >= MAX_RECORDED:
            self._slow.clear()
        self._slow.add(contact.node_id)

    def order_by_speed(self, contacts: Iterable[Contact]) -> list[Contact]:
        """Return ``contacts`` in a random order that distributes the load, with slow contacts last."""
        shuffled = list(contacts)
        self._rng.shuffle(shuffled)
        return sorted(shuffled, key=lambda contact: contact.node_id in self._slow)

    def silence(self, contact: Contact) -> float:
        """Return the seconds since the last datagram of ``contact``."""
        return self._clock.seconds() - self._last_received_at.get(contact.node_id, float("-inf"))

    def mark_authenticated(self, contact: Contact) -> None:
        """Record that ``contact`` has proved its key and its address by an answer."""
        if contact.node_id == self.own_id:
            return
        now, node_id = self._clock.seconds(), contact.node_id
        is_fresh = now - self._last_received_at.get(node_id, -RECORD_INTERVAL_S) < RECORD_INTERVAL_S
        if (
            is_fresh
            and node_id not in self._misses
            and node_id not in self._slow
            and self.find_contact(node_id) == contact
        ):
            return  # the contact was recorded a moment ago
        is_new = self.table.get(contact.node_id) is None and self.members.get(contact.node_id) is None
        put_bounded(self._last_received_at, node_id, now, MAX_RECORDED)
        self._misses.pop(contact.node_id, None)
        self._slow.discard(contact.node_id)
        doubtful = self.table.record_contact(contact, now)
        if doubtful is not None and self.silence(doubtful) >= self.max_silence:
            self._background.fork(self.check(doubtful))
        is_in_table = self.table.get(node_id) is not None
        is_new_here = self._belongs_to_members(node_id, is_in_table) and self.members.mark_alive(contact, now)
        if is_new_here or (is_new and is_in_table):
            # Called one reactor turn later, because messages to a newcomer must not overtake the answer to its own
            # request.
            self._background.later(0.0, self.on_new_contact, contact)

    def process_message(self, contact: Contact) -> None:
        """Record a message of ``contact`` in its session; a new address must be authenticated first."""
        if self.find_contact(contact.node_id) == contact:
            self.mark_authenticated(contact)
            return
        now = self._clock.seconds()
        if self.is_large and self.is_surely_large and not self.table.has_room(contact.node_id):
            return
        if (
            contact.node_id == self.own_id
            or now - self._checked_at.get(contact.node_id, -CHECK_INTERVAL_S) < CHECK_INTERVAL_S
        ):
            # in a large network, two nodes must not ping each other forever if neither has space for the other in its
            # routing table
            return
        if len(self._checked_at) > MAX_FOUND:
            self._checked_at.clear()
        self._checked_at[contact.node_id] = now
        self._background.fork(self.check(contact))

    def remove(self, contact: Contact) -> None:
        """Delete ``contact``, which left the network."""
        self.table.remove(contact, self._clock.seconds())
        self.members.remove(contact.node_id)
        self._forget(contact)

    def mark_rejecting(self, contact: Contact) -> None:
        """Record that ``contact`` rejects this node; if it is a member, it is then absent."""
        now = self._clock.seconds()
        self.table.remove(contact, now)
        if self.members.mark_absent(contact.node_id, now):
            self._forget(contact)

    def find_known(self, node_id: bytes) -> Contact | None:
        """Return the contact with this id, including absent members."""
        absent = (contact for contact in self.members.list_absent() if contact.node_id == node_id)
        return self.find_contact(node_id) or next(absent, None)

    def contacts(self) -> list[Contact]:
        """Return all contacts."""
        return list({c.node_id: c for c in [*self.table.list_contacts(), *self.members.list_live()]}.values())

    async def check(self, contact: Contact) -> None:
        """Ping ``contact``; in a large network without opening a session."""
        await self.ask(contact, "ping", self.members.digest(), changes=True, is_light=self.is_large)

    def silences(self) -> list[tuple[bytes, float]]:
        """Return the ids of recently heard nodes with their silence in seconds, the longest first."""
        now = self._clock.seconds()
        return [(node_id, now - at) for node_id, at in self._last_received_at.items()]

    def find_contact(self, node_id: bytes) -> Contact | None:
        """Return the contact with this id."""
        return self.members.get(node_id) or self.table.get(node_id)

    def is_contact(self, contact: Contact) -> bool:
        """Return whether a contact with this key and address is known."""
        return self.find_contact(contact.node_id) == contact

    def record_miss(self, contact: Contact, is_over: bool = False) -> None:
        """Record that ``contact`` did not answer; ``is_over``: delete it immediately.

        In a large network one miss makes a distant contact stale.  Any contact in the same range of ids can replace a
        distant contact, and a lookup that waits for a failed node is more expensive than a lookup that skips a live
        node.
        """
        now = self._clock.seconds()
        count, at = self._misses.get(contact.node_id, (0, -MISS_INTERVAL_S))
        if now - at < MISS_INTERVAL_S and not is_over:
            return
        was_known = self.table.get(contact.node_id) is not None
        is_far = self.is_large and was_known and contact not in self.find_neighbours()
        count += STALE_AFTER if is_far or is_over else 1
        if len(self._misses) >= MAX_RECORDED or len(self._slow) >= MAX_RECORDED:
            self._misses.clear()
            self._slow.clear()
        self._slow.add(contact.node_id)
        self._misses[contact.node_id] = (count, now)
        if is_over:
            self.table.remove(contact, now)
        for _ in range(STALE_AFTER if is_far else 1):
            self.table.record_miss(contact, now)
        if count < STALE_AFTER:
            return
        was_member = self.members.mark_absent(contact.node_id, now)
        if was_member or (was_known and self.table.get(contact.node_id) is None) or not was_known:
            self._forget(contact)

    def list_suspects(self) -> list[Contact]:
        """Return the contacts that did not answer the latest request."""
        return [contact for node_id in self._misses if (contact := self.find_contact(node_id)) is not None]

    @property
    def has_suspects(self) -> bool:
        """Whether any node did not answer the latest request."""
        return bool(self._misses)

    def is_suspect(self, contact: Contact) -> bool:
        """Return whether ``contact`` did not answer the latest request."""
        return contact.node_id in self._misses

    def enter_large_mode(self) -> None:
        """Use only the routing table from now on, because the network is too large to know all its members."""
        self.has_all_members, self.is_large = False, True
        self._endpoint.peers.is_large = True
        self.delete_unneeded()

    def leave_large_mode(self) -> None:
        """Learn all members again like a newcomer, because the network is no longer large."""
        self.is_large, self.max_silence = False, 0.0
        self._endpoint.peers.is_large = False
        for contact in self.table.list_contacts():
            self.members.mark_alive(contact, self._clock.seconds())

    def delete_unneeded(self) -> None:
        """Delete state that is unnecessary in a large network.

        This is members that are absent or also in the routing table, and old times of datagrams and misses.
        """
        table, live = self.table, self.members.list_live()
        spare = max(0, MAX_MEMBERS - len(table))
        extra = [contact.node_id for contact in live if table.get(contact.node_id) is None]
        kept = frozenset(extra[:spare])
        self.members.remove_all([c.node_id for c in (*live, *self.members.list_absent()) if c.node_id not in kept])
        before = self._clock.seconds() - CHECK_INTERVAL_S
        senders = self._last_received_at
        unheard = {c.node_id: float("-inf") for c in table.list_contacts() if c.node_id not in senders}
        for node_id in [node_id for node_id in self._misses if self.find_contact(node_id) is None]:
            del self._misses[node_id]
        self._last_received_at = unheard | {
            node_id: at
            for node_id, at in senders.items()
            if at > before or node_id in kept or table.get(node_id) is not None
        }

    # -- private ----------------------------------------------------------------------------------------------------

    async def _wait(self, is_over: Callable[[], bool], steps: int, step: float) -> None:
        """Wait until ``is_over``, checking every ``step`` seconds, at most ``steps`` times."""
        for _ in range(steps):
            if is_over():
                return
            await self._background.sleep(step)

    def _belongs_to_members(self, node_id: bytes, is_in_table: bool) -> bool:
        if not self.is_large:
            return True
        return not is_in_table and (self.members.get(node_id) is not None or not self.is_surely_large)

    def _forget(self, contact: Contact) -> None:
        for memory in (self._last_received_at, self._misses):
            memory.pop(contact.node_id, None)
        self._slow.discard(contact.node_id)
        for found in self._lookup_results.values():
            found[:] = [c for c in found if c.node_id != contact.node_id]
        self.on_lost(contact)

    def _answer_find_node(self, peer: Contact, target: bytes) -> list[object]:
        if len(target) != len(peer.node_id):
            raise Refused("find_node: the argument must be a node id of 20 bytes")
        return [c.pack() for c in self.find_nearest(target) if c.node_id != peer.node_id]

    def find_nearest(self, target: bytes) -> list[Contact]:
        """Return the k contacts closest to ``target`` that this node knows, except itself."""
        members, near = self.members.list_live(), self.table.closest(target)
        if not members:
            return near
        return select_closest({c.node_id: c for c in [*members, *near]}.values(), target, K)


def parse_contacts(answer: object) -> list[Contact]:
    """Decode the contacts in an answer; skip invalid contacts."""
    found = [parse_contact(fields) for fields in answer] if isinstance(answer, list) else []
    return [contact for contact in found if contact is not None]


def _closest(contacts: list[Contact], key: bytes) -> list[Contact]:
    """Return the k contacts closest to ``key``, each node once; of two addresses of one node use the first."""
    once: dict[bytes, Contact] = {}
    for contact in contacts:
        once.setdefault(contact.node_id, contact)
    return select_closest(once.values(), key, K)
