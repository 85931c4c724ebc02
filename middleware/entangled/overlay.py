"""Overlay: the contacts of a node, and the way to those closest to an id (Kademlia, sections 2.2 to 2.4).

A contact enters the table only when it has proved its key from its address; one that stays silent is asked, and goes
after several misses.  Where records belong follows from here: to the k closest nodes of their key.
"""

from __future__ import annotations

import random
from collections import OrderedDict
from collections.abc import Callable, Sequence
from typing import Any

from twisted.internet.defer import Deferred, DeferredList
from twisted.internet.interfaces import IReactorTime
from twisted.logger import Logger

from middleware.entangled.background import Background
from middleware.entangled.errors import EntangledError, NoAnswer, NotRunning, Refused
from middleware.entangled.kademlia.contact import Contact, unpacked
from middleware.entangled.kademlia.distance import closest
from middleware.entangled.kademlia.lookup import Lookup
from middleware.entangled.kademlia.routing import STALE_AFTER, RoutingTable
from middleware.entangled.network.network import Address
from middleware.entangled.wire.endpoint import Endpoint

K = 8
ALPHA = 3
SILENCE = 3.0
"""Seconds without a word after which a contact is asked whether it is still there."""
PROBE = 1.0
REFRESH = 10.0
HEDGE = 0.15
"""Seconds after which a lookup asks one more node beside one that has not answered yet."""
BACKOFF = (0.2, 5.0)
MAX_FORMER = 32
"""Addresses of known nodes and lost contacts that are tried when nobody is left."""
MAX_FOUND = 512
"""Keys whose closest nodes, as the last lookup found them, are remembered."""

OnContact = Callable[[Contact], None]


class Overlay:
    """Who a node knows; ``on_newcomer`` and ``on_lost`` are told of contacts that enter and leave the table."""

    _log = Logger()

    def __init__(
        self, me: Callable[[], Contact], endpoint: Endpoint, clock: IReactorTime, rng: random.Random, chores: Background
    ) -> None:
        self._me = me
        self._endpoint = endpoint
        self._clock = clock
        self._rng = rng
        self._chores = chores
        self.table = RoutingTable(me().node_id, K)
        self.on_newcomer: OnContact = lambda contact: None
        self.on_lost: OnContact = lambda contact: None
        self._heard_at: dict[bytes, float] = {}
        self._found: OrderedDict[bytes, list[Contact]] = OrderedDict()
        self._misses: dict[bytes, int] = {}
        endpoint.on_contact = self.heard
        self._former: dict[Address, None] = {}
        self._returning = False
        endpoint.expose("ping", self._answer_ping, changes=True)
        endpoint.expose("find_node", self._answer_find_node)

    def start(self) -> None:
        """Keep the contacts fresh from now on."""
        self._chores.every(PROBE, self._probe)
        self._chores.every(REFRESH, lambda: self._chores.fork(self.lookup(self._me().node_id)))

    async def join(self, known: Sequence[Address], remembered: Sequence[Address] = ()) -> None:
        """Greet the known nodes, with back-off until one answers, then look up the own id.

        ``remembered`` are greeted beside them, and waited for only where there are known nodes: without any, this may
        be the first node of its network.  A known node that turns out to be this one is waited for no longer.
        """
        others, pause = list(known), BACKOFF[0]
        self._former |= dict.fromkeys([*known, *remembered])
        while others or remembered:
            if await self._greeted(others, remembered):
                await self.lookup(self._me().node_id)
                return
            if self._chores.is_stopped:
                raise NotRunning("the node stopped while it was joining")
            if not others:
                return
            addresses = ", ".join(map(str, others))
            self._log.info("no answer from {known}; trying again in {s:.1f} s", known=addresses, s=pause)
            await self._chores.sleep(pause * (0.75 + self._rng.random() / 2))
            pause = min(pause * 2, BACKOFF[1])

    async def _greeted(self, known: list[Address], remembered: Sequence[Address]) -> bool:
        """Whether any of them is there; takes those out of ``known`` at which this node itself answers."""
        addresses = list(dict.fromkeys([*known, *remembered]))
        greetings = await DeferredList([self._endpoint.greet(address) for address in addresses], consumeErrors=True)
        found = []
        for address, (ok, contact) in zip(addresses, greetings, strict=True):
            if ok and contact.node_id == self._me().node_id:
                known[:] = [other for other in known if other != address]
            elif ok:
                found.append(contact)
        pings = await DeferredList(
            [self._endpoint.ask(contact, "ping", changes=True) for contact in found], consumeErrors=True
        )
        return any(ok for ok, _ in pings)

    # -- where things belong ----------------------------------------------------------------------------------------

    def responsible(self, key: bytes) -> list[Contact]:
        """The k closest nodes to ``key`` that are known here, this one included, the closest first."""
        return _closest([*self._found.get(key, ()), *self.table.closest(key), self._me()], key)

    def keepers(self, key: bytes) -> list[Contact]:
        """The nodes, this one not included, that may hold records of ``key``: those responsible, and those last found.

        A bucket has room for k contacts only, so in a large network not all that were found are in the table.
        """
        both = {c.node_id: c for c in [*self._found.get(key, ()), *self.responsible(key)]}
        return [contact for node_id, contact in both.items() if node_id != self._me().node_id]

    def belongs(self, key: bytes, contact: Contact) -> bool:
        """Whether ``contact`` is among the k closest to ``key``, as far as is known here."""
        return any(c.node_id == contact.node_id for c in self.responsible(key))

    async def holders(self, key: bytes) -> list[Contact]:
        """The k closest live nodes to ``key``; looked up where there may be more nodes than are known."""
        if len(self.table) < K:
            self._found.pop(key, None)
            return self.responsible(key)
        found = await self.lookup(key)
        self._found[key] = found
        self._found.move_to_end(key)
        if len(self._found) > MAX_FOUND:
            self._found.popitem(last=False)
        return _closest([*found, self._me()], key) if len(found) >= K else self.responsible(key)

    async def lookup(self, target: bytes) -> list[Contact]:
        """The k live nodes closest to ``target``, this one not included (Kademlia, section 2.3)."""
        lookup = Lookup(target, K, ALPHA, self.table.closest(target), exclude=self._me().node_id)
        done: Deferred[None] = Deferred()

        def step() -> None:
            for contact in lookup.next():
                self._chores.fork(visit(contact))
            if lookup.is_finished and not done.called:
                done.callback(None)

        def hedge(contact: Contact) -> None:
            lookup.slow(contact)
            step()

        async def visit(contact: Contact) -> None:
            in_time = self._chores.later(HEDGE, hedge, contact)
            try:
                answer = await self.ask(contact, "find_node", target)
                found = [unpacked(fields) for fields in answer] if isinstance(answer, list) else []
                lookup.answered(contact, [c for c in found if c is not None])
            except EntangledError:
                lookup.failed(contact)
            in_time()
            step()

        step()
        await done
        return lookup.closest()

    # -- who is there -----------------------------------------------------------------------------------------------

    async def ask(
        self, contact: Contact, method: str, *arguments: object, changes: bool = False, timeout: float | None = None
    ) -> Any:
        """Ask ``contact``; one that does not answer is on its way out of the table."""
        try:
            answer = await self._endpoint.ask(contact, method, *arguments, changes=changes, timeout=timeout)
        except NoAnswer:
            self._missed(contact)
            raise
        return answer

    def _missed(self, contact: Contact) -> None:
        was_known = self.table.get(contact.node_id) is not None
        self.table.failed(contact, self._clock.seconds())
        if self.table.get(contact.node_id) is not None:
            return
        self._misses[contact.node_id] = self._misses.get(contact.node_id, 0) + 1
        # One that a full bucket keeps out of the table is not lost by a single miss either.
        if was_known or self._misses[contact.node_id] >= STALE_AFTER:
            self._forget(contact)

    def _forget(self, contact: Contact) -> None:
        self._former.pop(contact.address, None)
        self._former[contact.address] = None
        if len(self._former) > MAX_FORMER:
            del self._former[next(iter(self._former))]
        self._heard_at.pop(contact.node_id, None)
        self._misses.pop(contact.node_id, None)
        for found in self._found.values():
            found[:] = [c for c in found if c.node_id != contact.node_id]
        self.on_lost(contact)

    def heard(self, contact: Contact) -> None:
        """``contact`` has proved its key and address, be it by an answer or by a question in its session."""
        if contact.node_id == self._me().node_id:
            return
        now = self._clock.seconds()
        known = self.table.get(contact.node_id)
        self._heard_at[contact.node_id] = now
        self._misses.pop(contact.node_id, None)
        doubtful = self.table.saw(contact, now)
        if doubtful is not None:
            self._chores.fork(self._check(doubtful))
        if known is None and self.table.get(contact.node_id) is not None:
            # A turn later: what a newcomer is told shall not overtake the answer to its own greeting.
            self._chores.later(0.0, self.on_newcomer, contact)

    def left(self, contact: Contact) -> None:
        """``contact`` said goodbye."""
        self.table.remove(contact, self._clock.seconds())
        self._forget(contact)

    async def _return(self) -> None:
        """Look for those that were known once: a radio that was out costs a node all its contacts."""
        self._returning = True
        try:
            if await self._greeted([], list(self._former)):
                await self.lookup(self._me().node_id)
        finally:
            self._returning = False

    def _probe(self) -> None:
        if not len(self.table) and self._former and not self._returning:
            self._chores.fork(self._return())
        now = self._clock.seconds()
        for contact in self.table.contacts():
            if now - self._heard_at.get(contact.node_id, -SILENCE) > SILENCE:
                self._chores.fork(self._check(contact))

    async def _check(self, contact: Contact) -> None:
        await self.ask(contact, "ping", changes=True)

    def _answer_ping(self, peer: Contact) -> str:
        self.heard(peer)
        return "pong"

    def _answer_find_node(self, peer: Contact, target: bytes) -> list[object]:
        if not isinstance(target, bytes) or len(target) != len(peer.node_id):
            raise Refused("find_node takes a node id of 20 bytes")
        return [c.packed() for c in self.table.closest(target) if c.node_id != peer.node_id]


def _closest(contacts: list[Contact], key: bytes) -> list[Contact]:
    """The k closest of ``contacts``, each node once; of two addresses of one node the first one named holds."""
    once: dict[bytes, Contact] = {}
    for contact in contacts:
        once.setdefault(contact.node_id, contact)
    return closest(once.values(), key, K)
