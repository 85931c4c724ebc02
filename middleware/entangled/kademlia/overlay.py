"""Overlay: the contacts of a node, and the way to those closest to an id (Kademlia, sections 2.2 to 2.4).

A contact enters only when it has answered from its address with its key.  Where records belong follows from here: to
the k closest live nodes of their key.  A team whose members are all known (``roster``) needs no walk for that; beyond,
iterative lookups find them.
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
from middleware.entangled.bounded import keep
from middleware.entangled.contact import Contact, unpacked
from middleware.entangled.errors import EntangledError, NoAnswer, Refused
from middleware.entangled.kademlia.distance import closest
from middleware.entangled.kademlia.lookup import Lookup
from middleware.entangled.kademlia.roster import MAX_MEMBERS, Roster
from middleware.entangled.kademlia.routing import STALE_AFTER, RoutingTable
from middleware.entangled.listeners import Listeners
from middleware.entangled.wire.congestion import RoundTrip
from middleware.entangled.wire.endpoint import Endpoint

K = 8
ALPHA = 3
CHECK_GAP = 4.0
"""Seconds before a stranger, or a contact at a new address, is asked again to prove itself."""
MISS_GAP = 0.5
"""Seconds in which several unanswered questions are one miss: a burst of questions is no proof of death."""
FRESH = 0.1
"""Seconds within which one sign of life is as good as many."""
FIRST_HEDGE, MOST_HEDGE = 0.01, 0.15
"""Seconds after which others are asked beside one that does not answer: while nobody was measured yet, and at most;
else those within which nearly every answer comes."""
LEAST_PATIENCE, MOST_PATIENCE, TRIES = 0.4, 2.5, 2.6
"""Seconds, at least and at most, and usual waits that a question of a lookup may take in a large network: two tries
where little is lost, as many as it takes where much is."""
MAX_FOUND = 512
"""Keys whose closest nodes, as the last lookup found them, are remembered."""
MAX_HEARD = 4096
"""Contacts of which is kept when they were heard, or missed; who was heard longest ago is forgotten first."""

PLACING, PLACING_STEP = 15, 0.1
MEETING, MEETING_STEP = 75, 0.02
"""Steps for which what needs a majority waits until the members are known, and seconds of each."""
LOOKUPS_KEPT = 16


class Voters(NamedTuple):
    """The nodes among which a majority is counted: the known ``ids``, and the number of all (``size``)."""

    ids: frozenset[bytes]
    size: int

    @property
    def majority(self) -> int:
        """The least number of votes that is more than half."""
        return self.size // 2 + 1

    def count_known(self, ids: Iterable[bytes]) -> int:
        """Return how many of ``ids`` are voters."""
        return len(self.ids.intersection(ids))


class Looked(NamedTuple):
    """A lookup that has ended: how many were asked, in how many hops, how many were found, in how many seconds."""

    key: bytes
    asked: int
    hops: int
    found: int
    seconds: float


class Overlay:
    """Who a node knows.

    ``patience`` is for how many seconds a contact may have been silent that is not asked for a newcomer's sake.
    ``on_newcomer`` and ``on_lost`` are told of contacts that come and go, ``on_named`` of each that another one names.

    ``is_whole`` says whether all members of the team are known, ``is_large`` that there are too many for that,
    ``is_placed`` whether this node has looked around at all, so that where it knows few there are few; whoever asks
    around sets them.  In a large network the table counts, and the roster has only some whom the table has no place
    for, where it knows few.
    """

    def __init__(self, me: Callable[[], Contact], endpoint: Endpoint, clock: IReactorTime, chores: Background) -> None:
        self.me = me
        self.own_id = me().node_id
        self._endpoint = endpoint
        self._clock = clock
        self._chores = chores
        self.table = RoutingTable(self.own_id, K)
        self.roster = Roster(self.own_id)
        self.is_whole = False
        self.is_large = False
        self.is_placed = False
        self.on_newcomer = Listeners[[Contact]]()
        self.on_lost = Listeners[[Contact]]()
        self.on_named = Listeners[[Contact, Contact]]()
        self._heard_at: dict[bytes, float] = {}
        self._round_trip = RoundTrip(FIRST_HEDGE)
        self._slow: set[bytes] = set()
        self._found: dict[bytes, list[Contact]] = {}
        self._misses: dict[bytes, tuple[int, float]] = {}
        self._near: list[Contact] = []
        self._near_of = (-1, -1)
        self.patience = 0.0
        self._checked_at: dict[bytes, float] = {}
        self.lookups: deque[Looked] = deque(maxlen=LOOKUPS_KEPT)
        endpoint.on_contact.add(self.proved)
        endpoint.expose("find_node", self._answer_find_node, early=True)

    @cached_property
    def _dice(self) -> random.Random:
        # They only spread the load, so anybody may foretell them; those of the machine would be a system call each.
        return random.Random(int.from_bytes(self.own_id))

    # -- where things belong ----------------------------------------------------------------------------------------

    @property
    def is_complete(self) -> bool:
        """Whether everybody is known, so that nothing has to be looked up."""
        return self.is_whole and not self.roster.is_full

    @property
    def is_sparse(self) -> bool:
        """Whether there are more nodes than are known here, so that those close to a key have to be looked up."""
        return not self.is_complete and (len(self.table) >= K or not self.is_placed)

    def responsible(self, key: bytes) -> list[Contact]:
        """The k closest live nodes to ``key`` that are known here, this one included, the closest first."""
        if self.is_complete:
            return self.roster.closest(key, K, self.me())
        known = [*self._found.get(key, ()), *self.table.closest(key), *self.roster.live(), self.me()]
        return _closest(known, key)

    def neighbours(self) -> list[Contact]:
        """The k contacts closest to this node: they are found with it, and hold what it holds."""
        version = self.table.version, self.roster.version
        if self._near_of != version:
            self._near_of, self._near = version, self.nearest(self.own_id)
        return self._near

    @property
    def sees_many(self) -> bool:
        """Whether so many are known here that nobody need be asked whether the network is large."""
        return self.roster.is_full or len(self.table) + len(self.roster) >= MAX_MEMBERS

    def keepers(self, key: bytes) -> list[Contact]:
        """The nodes, this one not included, that may hold records of ``key``: those responsible, and those last found.

        A bucket has room for k contacts only, so in a large network not all that were found are in the table.
        """
        if self.is_complete:
            return [c for c in self.responsible(key) if c.node_id != self.own_id]
        both = {c.node_id: c for c in [*self._found.get(key, ()), *self.responsible(key)]}
        return [contact for node_id, contact in both.items() if node_id != self.own_id]

    def is_responsible(self, key: bytes) -> bool:
        """Say whether this node is one of the k closest to ``key``, as far as is known here."""
        return self.belongs(key, self.me())

    def belongs(self, key: bytes, contact: Contact) -> bool:
        """Whether ``contact`` is among the k closest to ``key``, as far as is known here."""
        return any(c.node_id == contact.node_id for c in self.responsible(key))

    async def holders(self, key: bytes) -> list[Contact]:
        """The k closest live nodes to ``key``, this one included; looked up where not all nodes are known.

        A node that is still joining waits a little, for it knows nobody to ask.
        """
        await self._wait(lambda: self.is_whole or self.is_large or len(self.roster) > 0, PLACING, PLACING_STEP)
        if not self.is_sparse:
            self._found.pop(key, None)
            return self.responsible(key)
        found = await self.lookup(key)
        nearest = _closest([*found, self.me()], key)
        self.note_found(key, [contact for contact in nearest if contact.node_id != self.own_id])
        return nearest if len(found) >= K else self.responsible(key)

    async def met(self) -> None:
        """Give a node that is still joining a moment to learn who is there."""
        await self._wait(lambda: self.is_whole or self.is_large, MEETING, MEETING_STEP)

    def note_found(self, key: bytes, found: list[Contact]) -> None:
        """Keep in mind what a lookup found."""
        keep(self._found, key, found, MAX_FOUND)

    def voters(self, key: bytes, targets: list[Contact]) -> Voters:
        """Return the voters for ``key``, whose replicas are ``targets``.

        In a team small enough for a roster absent members are voters too; in a larger network, the nodes found.
        """
        if not (self.is_whole or self.is_large):
            # It has not met its team yet: the few nodes that it knows must not count as all.
            return Voters(frozenset([self.own_id]), 2)
        absent = [] if self.roster.is_full or self.is_large else self.roster.absent()
        ids = frozenset(contact.node_id for contact in (_closest([*targets, *absent], key) if absent else targets))
        return Voters(ids, len(ids))

    async def lookup(self, target: bytes) -> list[Contact]:
        """The k live nodes closest to ``target``, this one not included (Kademlia, section 2.3)."""
        seeds = [*self.table.closest(target), *(self.roster.closest(target, K, self.me()) if len(self.roster) else ())]
        lookup = Lookup(target, K, ALPHA, seeds, exclude=self.own_id)
        began = self._clock.seconds()
        self.table.searched(target, began)
        hops: dict[bytes, int] = {}
        asked: list[int] = []

        async def visit(contact: Contact) -> None:
            asked.append(hops.setdefault(contact.node_id, 1))
            named = contacts_of(await self._asked_for(contact, target))
            for other in named:
                self.on_named(other, contact)
                hops.setdefault(other.node_id, hops[contact.node_id] + 1)
            lookup.answered(contact, named)

        await self.walk(lookup, visit)
        found = lookup.closest()
        took = self._clock.seconds() - began
        self.lookups.append(Looked(target, len(asked), max(asked, default=0), len(found), took))
        return found

    async def walk(
        self, lookup: Lookup, visit: Callable[[Contact], Any], is_done: Callable[[], bool] = lambda: False
    ) -> None:
        """Visit whom ``lookup`` names, alpha at a time and one more beside each slow one, until it ends."""
        done: Deferred[None] = Deferred()

        def step() -> None:
            if done.called:
                return
            if lookup.is_finished or is_done():
                done.callback(None)
                return
            for contact in lookup.next():
                self._chores.fork(go(contact))

        def hedge(contact: Contact) -> None:
            self.slow(contact)
            lookup.slow(contact)
            step()

        async def go(contact: Contact) -> None:
            in_time = self._chores.later(self.hedge(), hedge, contact)
            try:
                await visit(contact)
            except EntangledError:
                lookup.failed(contact)
            in_time()
            step()

        step()
        await done

    # -- who is there -----------------------------------------------------------------------------------------------

    async def ask(
        self,
        contact: Contact,
        method: str,
        *arguments: object,
        changes: bool = False,
        timeout: float | None = None,
        is_light: bool = False,
    ) -> Any:
        """Ask ``contact``; one that does not answer is on its way out."""
        began = self._clock.seconds()
        is_met = self._endpoint.is_met(contact)
        try:
            answer = await self._endpoint.ask(
                contact, method, *arguments, changes=changes, timeout=timeout, is_light=is_light
            )
        except NoAnswer:
            self.missed(contact)
            raise
        if is_met:  # else it was a handshake, too
            self._round_trip.measured(self._clock.seconds() - began)
        return answer

    async def _asked_for(self, contact: Contact, target: bytes) -> Any:
        """Whom ``contact`` knows near ``target``.

        One that was heard while its answer was waited for is asked once more: where several lookups meet a stranger at
        the same moment, only one question rides in the handshake, and the time of the others may be over after it.
        """
        began = self._clock.seconds()
        try:
            return await self.ask(contact, "find_node", target, timeout=self.patience_of_lookups)
        except NoAnswer:
            if self.silence(contact) >= self._clock.seconds() - began:
                raise
            return await self.ask(contact, "find_node", target, timeout=self.patience_of_lookups)

    def hedge(self) -> float:
        """Seconds after which others are asked beside one that does not answer: hardly any of this team takes longer.

        The time of all is a better measure than a contact's own, of which there are few samples and old ones; to ask
        one that is much farther away than the others costs a question or two more.
        """
        if self.is_large:  # strangers take a handshake, and may be far away
            guess = self._endpoint.peers.guess
            return guess if not self._round_trip.is_measured else min(guess, max(MOST_HEDGE, self._round_trip.usual))
        return min(MOST_HEDGE, self._round_trip.usual)

    @property
    def patience_of_lookups(self) -> float | None:
        """Seconds that one question of a lookup may take; None: as long as any.

        In a large network there are always others, and some of those that are named are dead.
        """
        if not self.is_large:
            return None
        peers = self._endpoint.peers
        return min(MOST_PATIENCE, max(LEAST_PATIENCE, max(TRIES, peers.loss.tries) * peers.guess))

    def slow(self, contact: Contact) -> None:
        """``contact`` took longer than it should; until it is heard, others are asked first."""
        if len(self._slow) >= MAX_HEARD:
            self._slow.clear()
        self._slow.add(contact.node_id)

    def quickest(self, contacts: Iterable[Contact]) -> list[Contact]:
        """``contacts`` in an order that spreads the load, those that are slow at the moment last."""
        shuffled = list(contacts)
        self._dice.shuffle(shuffled)
        return sorted(shuffled, key=lambda contact: contact.node_id in self._slow)

    def silence(self, contact: Contact) -> float:
        """Seconds since ``contact`` was heard."""
        return self._clock.seconds() - self._heard_at.get(contact.node_id, float("-inf"))

    def proved(self, contact: Contact) -> None:
        """``contact`` has proved its key and its address: it answered from there."""
        if contact.node_id == self.own_id:
            return
        now, node_id = self._clock.seconds(), contact.node_id
        is_fresh = now - self._heard_at.get(node_id, -FRESH) < FRESH
        if is_fresh and node_id not in self._misses and node_id not in self._slow and self.contact(node_id) == contact:
            return  # it was said a moment ago
        is_new = self.table.get(contact.node_id) is None and self.roster.get(contact.node_id) is None
        keep(self._heard_at, node_id, now, MAX_HEARD)
        self._misses.pop(contact.node_id, None)
        self._slow.discard(contact.node_id)
        doubtful = self.table.saw(contact, now)
        if doubtful is not None and self.silence(doubtful) >= self.patience:
            self._chores.fork(self.check(doubtful))
        has_place = self.table.get(node_id) is not None
        is_new_here = self._is_for_roster(node_id, has_place) and self.roster.heard(contact, now)
        if is_new_here or (is_new and has_place):
            # A turn later: what a newcomer is told shall not overtake the answer to its own greeting.
            self._chores.later(0.0, self.on_newcomer, contact)

    def heard(self, contact: Contact) -> None:
        """``contact`` asked or told us something in its session; a new address it has to prove first."""
        if self.contact(contact.node_id) == contact:
            self.proved(contact)
            return
        now = self._clock.seconds()
        if self.is_large and self.sees_many and not self.table.has_place(contact.node_id):
            return
        if contact.node_id == self.own_id or now - self._checked_at.get(contact.node_id, -CHECK_GAP) < CHECK_GAP:
            return  # in a large network not everybody finds a place here: two such must not ping each other for ever
        if len(self._checked_at) > MAX_FOUND:
            self._checked_at.clear()
        self._checked_at[contact.node_id] = now
        self._chores.fork(self.check(contact))

    def left(self, contact: Contact) -> None:
        """``contact`` said goodbye."""
        self.table.remove(contact, self._clock.seconds())
        self.roster.left(contact.node_id)
        self._forget(contact)

    def turned_away(self, contact: Contact) -> None:
        """``contact`` does not let this node in; as a member it is absent."""
        now = self._clock.seconds()
        self.table.remove(contact, now)
        if self.roster.lost(contact.node_id, now):
            self._forget(contact)

    def known(self, node_id: bytes) -> Contact | None:
        """The contact with this id, the absent ones among the members too."""
        absent = (contact for contact in self.roster.absent() if contact.node_id == node_id)
        return self.contact(node_id) or next(absent, None)

    def contacts(self) -> list[Contact]:
        """Everybody who is known here."""
        return list({c.node_id: c for c in [*self.table.contacts(), *self.roster.live()]}.values())

    async def check(self, contact: Contact) -> None:
        """Ask ``contact`` whether it is there; in a large network none of them is worth a handshake."""
        await self.ask(contact, "ping", self.roster.digest(), changes=True, is_light=self.is_large)

    def silences(self) -> list[tuple[bytes, float]]:
        """The ids of contacts and perhaps of others, and for how many seconds each was silent, the longest first."""
        now = self._clock.seconds()
        return [(node_id, now - at) for node_id, at in self._heard_at.items()]

    def contact(self, node_id: bytes) -> Contact | None:
        """The contact with this id."""
        return self.roster.get(node_id) or self.table.get(node_id)

    def is_contact(self, contact: Contact) -> bool:
        """Whether this very contact is known."""
        return self.contact(contact.node_id) == contact

    def missed(self, contact: Contact, is_over: bool = False) -> None:
        """``contact`` did not answer, once more; ``is_over``: it is let go of at once.

        In a large network one miss makes a far contact stale: others of its range do as well, and a lookup that waits
        for the dead costs more than one that passes over the living.
        """
        now = self._clock.seconds()
        count, at = self._misses.get(contact.node_id, (0, -MISS_GAP))
        if now - at < MISS_GAP and not is_over:
            return
        was_known = self.table.get(contact.node_id) is not None
        is_far = self.is_large and was_known and contact not in self.neighbours()
        count += STALE_AFTER if is_far or is_over else 1
        if len(self._misses) >= MAX_HEARD or len(self._slow) >= MAX_HEARD:
            self._misses.clear()
            self._slow.clear()
        self._slow.add(contact.node_id)
        self._misses[contact.node_id] = (count, now)
        if is_over:
            self.table.remove(contact, now)
        for _ in range(STALE_AFTER if is_far else 1):
            self.table.failed(contact, now)
        if count < STALE_AFTER:
            return
        was_member = self.roster.lost(contact.node_id, now)
        if was_member or (was_known and self.table.get(contact.node_id) is None) or not was_known:
            self._forget(contact)

    def doubted(self) -> list[Contact]:
        """The contacts that did not answer the last time."""
        return [contact for node_id in self._misses if (contact := self.contact(node_id)) is not None]

    @property
    def is_anybody_doubted(self) -> bool:
        """Whether anybody did not answer the last time."""
        return bool(self._misses)

    def is_doubted(self, contact: Contact) -> bool:
        """Whether ``contact`` did not answer the last time."""
        return contact.node_id in self._misses

    def grew(self) -> None:
        """Go by the table from now on: the network is too large to be known whole."""
        self.is_whole, self.is_large = False, True
        self._endpoint.peers.is_wide = True
        self.tidy()

    def shrank(self) -> None:
        """Begin to know the members again, as a newcomer does: nobody has seen many for long."""
        self.is_large, self.patience = False, 0.0
        self._endpoint.peers.is_wide = False
        for contact in self.table.contacts():
            self.roster.heard(contact, self._clock.seconds())

    def tidy(self) -> None:
        """Forget whom a large network need not remember: members in the table or absent, and who was heard once."""
        table, live = self.table, self.roster.live()
        spare = max(0, MAX_MEMBERS - len(table))
        extra = [contact.node_id for contact in live if table.get(contact.node_id) is None]
        kept = frozenset(extra[:spare])
        self.roster.shed([c.node_id for c in (*live, *self.roster.absent()) if c.node_id not in kept])
        before = self._clock.seconds() - CHECK_GAP
        heard = self._heard_at
        unheard = {c.node_id: float("-inf") for c in table.contacts() if c.node_id not in heard}
        for node_id in [node_id for node_id in self._misses if self.contact(node_id) is None]:
            del self._misses[node_id]
        self._heard_at = unheard | {
            node_id: at
            for node_id, at in heard.items()
            if at > before or node_id in kept or table.get(node_id) is not None
        }

    # -- inside -----------------------------------------------------------------------------------------------------

    async def _wait(self, is_over: Callable[[], bool], steps: int, step: float) -> None:
        """Look again every ``step`` seconds until ``is_over``, for so many ``steps`` at most."""
        for _ in range(steps):
            if is_over():
                return
            await self._chores.sleep(step)

    def _is_for_roster(self, node_id: bytes, has_place: bool) -> bool:
        if not self.is_large:
            return True
        return not has_place and (self.roster.get(node_id) is not None or not self.sees_many)

    def _forget(self, contact: Contact) -> None:
        for memory in (self._heard_at, self._misses):
            memory.pop(contact.node_id, None)
        self._slow.discard(contact.node_id)
        for found in self._found.values():
            found[:] = [c for c in found if c.node_id != contact.node_id]
        self.on_lost(contact)

    def _answer_find_node(self, peer: Contact, target: bytes) -> list[object]:
        if len(target) != len(peer.node_id):
            raise Refused("find_node takes a node id of 20 bytes")
        return [c.packed() for c in self.nearest(target) if c.node_id != peer.node_id]

    def nearest(self, target: bytes) -> list[Contact]:
        """The k closest contacts to ``target`` that are known here, this node not included."""
        members, near = self.roster.live(), self.table.closest(target)
        if not members:
            return near
        return closest({c.node_id: c for c in [*members, *near]}.values(), target, K)


def contacts_of(answer: object) -> list[Contact]:
    """The contacts in an answer, those that are none left out."""
    found = [unpacked(fields) for fields in answer] if isinstance(answer, list) else []
    return [contact for contact in found if contact is not None]


def _closest(contacts: list[Contact], key: bytes) -> list[Contact]:
    """The k closest of ``contacts``, each node once; of two addresses of one node the first one named holds."""
    once: dict[bytes, Contact] = {}
    for contact in contacts:
        once.setdefault(contact.node_id, contact)
    return closest(once.values(), key, K)
