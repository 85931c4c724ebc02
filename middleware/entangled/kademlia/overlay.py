"""Overlay: the contacts of a node, and the way to those closest to an id (Kademlia, sections 2.2 to 2.4).

A contact enters only when it has answered from its address with its key.  Where records belong follows from here: to
the k closest live nodes of their key.  A team whose members are all known (``roster``) needs no walk for that; beyond,
iterative lookups find them.
"""

from __future__ import annotations

import random
from collections import OrderedDict, deque
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

from twisted.internet.defer import Deferred
from twisted.internet.interfaces import IReactorTime

from middleware.entangled.background import Background
from middleware.entangled.errors import EntangledError, NoAnswer, Refused
from middleware.entangled.kademlia.contact import Contact, unpacked
from middleware.entangled.kademlia.distance import closest
from middleware.entangled.kademlia.lookup import Lookup
from middleware.entangled.kademlia.roster import Roster
from middleware.entangled.kademlia.routing import STALE_AFTER, RoutingTable
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
MAX_FOUND = 512
"""Keys whose closest nodes, as the last lookup found them, are remembered."""

PLACING, PLACING_STEP = 15, 0.1
MEETING, MEETING_STEP = 75, 0.02
"""Steps for which what needs a majority waits until the members are known, and seconds of each."""
NOBODY = b""
"""Stands for members that must be there, though none is known yet."""

LOOKUPS_KEPT = 16

OnContact = Callable[[Contact], None]


class Looked(NamedTuple):
    """A lookup that has ended: how many were asked, in how many hops, how many were found, in how many seconds."""

    key: bytes
    asked: int
    hops: int
    found: int
    seconds: float


class Overlay:
    """Who a node knows; ``on_newcomer`` and ``on_lost`` are told of contacts that come and go.

    ``is_whole`` says whether all members of the team are known, ``is_large`` that there are too many for that,
    ``is_placed`` whether this node has looked around at
    all, so that where it knows few there are few; whoever asks around sets them.
    """

    def __init__(self, me: Callable[[], Contact], endpoint: Endpoint, clock: IReactorTime, chores: Background) -> None:
        self.me = me
        self.own_id = me().node_id
        self._endpoint = endpoint
        self._clock = clock
        # They only spread the load, so anybody may foretell them; those of the machine would be a system call each.
        self._dice = random.Random(int.from_bytes(self.own_id))
        self._chores = chores
        self.table = RoutingTable(self.own_id, K)
        self.roster = Roster(self.own_id)
        self.is_whole = False
        self.is_large = False
        self.is_placed = False
        self.on_newcomer: OnContact = lambda contact: None
        self.on_lost: OnContact = lambda contact: None
        self._heard_at: dict[bytes, float] = {}
        self._round_trip = RoundTrip(FIRST_HEDGE)
        self._slow: set[bytes] = set()
        self._found: OrderedDict[bytes, list[Contact]] = OrderedDict()
        self._misses: dict[bytes, tuple[int, float]] = {}
        self._checked_at: dict[bytes, float] = {}
        self.lookups: deque[Looked] = deque(maxlen=LOOKUPS_KEPT)
        endpoint.on_contact = self.proved
        endpoint.expose("find_node", self._answer_find_node)

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

    def keepers(self, key: bytes) -> list[Contact]:
        """The nodes, this one not included, that may hold records of ``key``: those responsible, and those last found.

        A bucket has room for k contacts only, so in a large network not all that were found are in the table.
        """
        if self.is_complete:
            return [c for c in self.responsible(key) if c.node_id != self.own_id]
        both = {c.node_id: c for c in [*self._found.get(key, ()), *self.responsible(key)]}
        return [contact for node_id, contact in both.items() if node_id != self.own_id]

    def belongs(self, key: bytes, contact: Contact) -> bool:
        """Whether ``contact`` is among the k closest to ``key``, as far as is known here."""
        return any(c.node_id == contact.node_id for c in self.responsible(key))

    async def holders(self, key: bytes) -> list[Contact]:
        """The k closest live nodes to ``key``, this one included; looked up where not all nodes are known.

        A node that is still joining waits a little, for it knows nobody to ask.
        """
        await self._wait(lambda: self.is_whole or len(self.roster) > 0, PLACING, PLACING_STEP)
        if not self.is_sparse:
            self._found.pop(key, None)
            return self.responsible(key)
        found = await self.lookup(key)
        self.note_found(key, found)
        return _closest([*found, self.me()], key) if len(found) >= K else self.responsible(key)

    async def met(self) -> None:
        """Give a node that is still joining a moment to learn who is there."""
        await self._wait(lambda: self.is_whole or self.is_large, MEETING, MEETING_STEP)

    def note_found(self, key: bytes, found: list[Contact]) -> None:
        """Keep in mind what a lookup found."""
        self._found[key] = found
        self._found.move_to_end(key)
        if len(self._found) > MAX_FOUND:
            self._found.popitem(last=False)

    def voters(self, key: bytes, targets: list[Contact]) -> list[bytes]:
        """The ids of the nodes among whom a majority for ``key`` is counted; ``targets`` are its holders.

        In a team small enough for a roster the absent ones count too; in a larger network, who was found.
        """
        if not (self.is_whole or self.is_large):
            # It has not met its team yet: whoever knows a few of them shall not take those for all.
            return [self.own_id, NOBODY]
        absent = [] if self.roster.is_full else self.roster.absent()
        return [contact.node_id for contact in (_closest([*targets, *absent], key) if absent else targets)]

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
            answer = await self.ask(contact, "find_node", target)
            named = contacts_of(answer)
            for other in named:
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
        self, contact: Contact, method: str, *arguments: object, changes: bool = False, timeout: float | None = None
    ) -> Any:
        """Ask ``contact``; one that does not answer is on its way out."""
        began = self._clock.seconds()
        is_met = self._endpoint.is_met(contact)
        try:
            answer = await self._endpoint.ask(contact, method, *arguments, changes=changes, timeout=timeout)
        except NoAnswer:
            self._missed(contact)
            raise
        if is_met:  # else it was a handshake, too
            self._round_trip.measured(self._clock.seconds() - began)
        return answer

    def hedge(self) -> float:
        """Seconds after which others are asked beside one that does not answer: hardly any of this team takes longer.

        The time of all is a better measure than a contact's own, of which there are few samples and old ones; to ask
        one that is much farther away than the others costs a question or two more.
        """
        return min(MOST_HEDGE, self._round_trip.usual)

    def slow(self, contact: Contact) -> None:
        """``contact`` took longer than it should; until it is heard, others are asked first."""
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
        if is_fresh and node_id not in self._misses and node_id not in self._slow and self._known(node_id) == contact:
            return  # it was said a moment ago
        is_new = self.table.get(contact.node_id) is None and self.roster.get(contact.node_id) is None
        self._heard_at[contact.node_id] = now
        self._misses.pop(contact.node_id, None)
        self._slow.discard(contact.node_id)
        doubtful = self.table.saw(contact, now)
        if doubtful is not None:
            self._chores.fork(self.check(doubtful))
        is_new_here = self.roster.heard(contact, now)
        if is_new_here or (is_new and self.table.get(contact.node_id) is not None):
            # A turn later: what a newcomer is told shall not overtake the answer to its own greeting.
            self._chores.later(0.0, self.on_newcomer, contact)

    def heard(self, contact: Contact) -> None:
        """``contact`` asked or told us something in its session; a new address it has to prove first."""
        if self._known(contact.node_id) == contact:
            self.proved(contact)
            return
        now = self._clock.seconds()
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

    def contacts(self) -> list[Contact]:
        """Everybody who is known here."""
        return list({c.node_id: c for c in [*self.table.contacts(), *self.roster.live()]}.values())

    async def check(self, contact: Contact) -> None:
        """Ask ``contact`` whether it is there."""
        await self.ask(contact, "ping", self.roster.digest(), changes=True)

    # -- inside -----------------------------------------------------------------------------------------------------

    async def _wait(self, is_over: Callable[[], bool], steps: int, step: float) -> None:
        """Look again every ``step`` seconds until ``is_over``, for so many ``steps`` at most."""
        for _ in range(steps):
            if is_over():
                return
            await self._chores.sleep(step)

    def _known(self, node_id: bytes) -> Contact | None:
        return self.roster.get(node_id) or self.table.get(node_id)

    def _missed(self, contact: Contact) -> None:
        now = self._clock.seconds()
        count, at = self._misses.get(contact.node_id, (0, -MISS_GAP))
        if now - at < MISS_GAP:
            return
        self._slow.add(contact.node_id)
        self._misses[contact.node_id] = (count + 1, now)
        was_known = self.table.get(contact.node_id) is not None
        self.table.failed(contact, now)
        if count + 1 < STALE_AFTER:
            return
        was_member = self.roster.lost(contact.node_id, now)
        if was_member or (was_known and self.table.get(contact.node_id) is None) or not was_known:
            self._forget(contact)

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
        known = {c.node_id: c for c in [*self.roster.live(), *self.table.closest(target)]}
        return closest(known.values(), target, K)


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
