"""Overlay: the contacts of a node, and the way to those closest to an id (Kademlia, sections 2.2 to 2.4).

A contact enters the table only when it has proved its key from its address; one that stays silent is asked, and goes after
several misses.  Where records belong follows from here: to the k closest nodes of their key.
"""

from __future__ import annotations

import random
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
from middleware.entangled.kademlia.routing import RoutingTable
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
        endpoint.on_contact = self.heard
        endpoint.expose("ping", self._answer_ping)
        endpoint.expose("find_node", self._answer_find_node)

    def start(self) -> None:
        """Keep the contacts fresh from now on."""
        self._chores.every(PROBE, self._probe)
        self._chores.every(REFRESH, lambda: self._chores.fork(self.lookup(self._me().node_id)))

    async def join(self, known: Sequence[Address]) -> None:
        """Greet the known nodes, with back-off until one answers, then look up the own id."""
        pause = BACKOFF[0]
        while known and not await self._greeted(known):
            if self._chores.is_stopped:
                raise NotRunning("the node stopped while it was joining")
            addresses = ", ".join(map(str, known))
            self._log.info("no answer from {known}; trying again in {s:.1f} s", known=addresses, s=pause)
            await self._chores.sleep(pause * (0.75 + self._rng.random() / 2))
            pause = min(pause * 2, BACKOFF[1])
        if known:
            await self.lookup(self._me().node_id)

    async def _greeted(self, known: Sequence[Address]) -> bool:
        greetings = await DeferredList([self._endpoint.greet(address) for address in known], consumeErrors=True)
        found = [contact for ok, contact in greetings if ok and contact.node_id != self._me().node_id]
        pings = await DeferredList([self._endpoint.ask(contact, "ping") for contact in found], consumeErrors=True)
        return any(ok for ok, _ in pings)

    # -- where things belong ----------------------------------------------------------------------------------------

    def responsible(self, key: bytes) -> list[Contact]:
        """The k closest nodes to ``key`` that are known here, this one included, the closest first."""
        return closest([*self.table.closest(key), self._me()], key, K)

    def belongs(self, key: bytes, contact: Contact) -> bool:
        """Whether ``contact`` is among the k closest to ``key``, as far as is known here."""
        return any(c.node_id == contact.node_id for c in self.responsible(key))

    async def holders(self, key: bytes) -> list[Contact]:
        """The k closest live nodes to ``key``; looked up unless the whole team is known."""
        if len(self.table) > K:
            await self.lookup(key)
        return self.responsible(key)

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
            self.table.failed(contact, self._clock.seconds())
            if self.table.get(contact.node_id) is None:
                self.on_lost(contact)
            raise
        self._heard_at[contact.node_id] = self._clock.seconds()
        return answer

    def heard(self, contact: Contact) -> None:
        """``contact`` has proved its key and address."""
        if contact.node_id == self._me().node_id:
            return
        now = self._clock.seconds()
        known = self.table.get(contact.node_id)
        self._heard_at[contact.node_id] = now
        doubtful = self.table.saw(contact, now)
        if doubtful is not None:
            self._chores.fork(self._check(doubtful))
        if known is None and self.table.get(contact.node_id) is not None:
            # A turn later: what a newcomer is told shall not overtake the answer to its own greeting.
            self._chores.later(0.0, self.on_newcomer, contact)

    def left(self, contact: Contact) -> None:
        """``contact`` said goodbye."""
        self.table.remove(contact)
        self.on_lost(contact)

    def _probe(self) -> None:
        now = self._clock.seconds()
        for contact in self.table.contacts():
            if now - self._heard_at.get(contact.node_id, 0.0) > SILENCE:
                self._chores.fork(self._check(contact))

    async def _check(self, contact: Contact) -> None:
        await self.ask(contact, "ping")

    def _answer_ping(self, peer: Contact) -> str:
        return "pong"

    def _answer_find_node(self, peer: Contact, target: bytes) -> list[object]:
        if not isinstance(target, bytes) or len(target) != len(peer.node_id):
            raise Refused("find_node takes a node id of 20 bytes")
        return [c.packed() for c in self.table.closest(target) if c.node_id != peer.node_id]
