"""Detour: the ways into the network for a node to which no datagram gets through, and the way back from them.

A tunnel costs whoever serves it memory and its users time, so it is taken only when no known node answers otherwise,
and given up as soon as its node answers without it.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Coroutine, Sequence
from typing import Any

from twisted.internet.defer import Deferred, DeferredList, FirstError
from twisted.internet.interfaces import IReactorTime
from twisted.logger import Logger

from middleware.entangled.background import Background, first
from middleware.entangled.contact import Contact
from middleware.entangled.errors import NoAnswer
from middleware.entangled.kademlia.overlay import Overlay
from middleware.entangled.network.network import Address
from middleware.entangled.wire.endpoint import Endpoint

AFTER_S = 1.5
"""Seconds for which the known nodes have the chance to answer without one."""
GREET_S = 4.0
"""Seconds for a greeting: names are looked up, TCP, TLS and a WebSocket are opened first."""
BACKOFF = (0.2, 0.8)
"""Seconds between two tries: where no tunnel is open a greeting costs nothing; when to dial is the tunnel's affair."""
AGAIN_S = (5.0, 15.0, 60.0)
"""Seconds between the tries to do without; the last one holds from then on."""
LOOK_S = 1.0
DIRECT_S = 0.5
"""Seconds for a greeting without a detour; whoever is there answers in one round trip."""

Enter = Callable[[Contact], Coroutine[Any, Any, None]]


class Detour:
    """The detours of one node; ``enter`` proves a contact that was found and compares its members with ours."""

    _log = Logger()

    def __init__(
        self,
        overlay: Overlay,
        endpoint: Endpoint,
        clock: IReactorTime,
        rng: random.Random,
        chores: Background,
        enter: Enter,
    ) -> None:
        self._overlay = overlay
        self._endpoint = endpoint
        self._clock = clock
        self._rng = rng
        self._chores = chores
        self._enter = enter
        self._ways: tuple[Address, ...] = ()
        self._known: tuple[Address, ...] = ()
        self._tries = 0
        self._next_at = float("inf")

    @property
    def is_possible(self) -> bool:
        """Whether there is any."""
        return bool(self._ways)

    def begin(self, ways: Sequence[Address], known: Sequence[Address]) -> None:
        """Take note of the detours, and of the known nodes that should be reached without; called once."""
        self._ways, self._known = tuple(ways), tuple(known)
        if ways:
            self._chores.every(LOOK_S, self._look)

    async def beside(self, join: Coroutine[Any, Any, None] | None) -> None:
        """Enter by ``join``, or by a detour where that takes too long, whichever is first; None: by a detour."""
        begun = [] if join is None else [Deferred.fromCoroutine(join)]
        try:
            await DeferredList(
                [*begun, Deferred.fromCoroutine(self._tried(0.0 if join is None else AFTER_S, begun))],
                fireOnOneCallback=True,
                fireOnOneErrback=True,
                consumeErrors=True,
            )
        except FirstError as error:
            error.subFailure.raiseException()

    async def taken(self) -> bool:
        """Whether somebody of the team answers by any detour; the first one is enough."""
        return bool(await first(1, [self._by(way) for way in self._ways]))

    # -- inside -----------------------------------------------------------------------------------------------------

    async def _tried(self, wait: float, others: Sequence[Deferred[None]]) -> None:
        """Try all detours again and again, until one leads in or another way did."""
        pause = BACKOFF[0]
        while True:
            if wait:
                await self._chores.sleep(wait)
            if any(other.called for other in others) or await self.taken():
                return
            wait = pause * (0.75 + self._rng.random() / 2)
            pause = min(pause * 2, BACKOFF[1])

    async def _by(self, way: Address) -> bool:
        contact = await self._endpoint.greet(way, GREET_S)
        if contact.node_id == self._overlay.own_id:
            raise NoAnswer(f"{way} leads to this node itself")
        await self._enter(contact)
        return True

    def _look(self) -> None:
        """Now and then see whether those to whom a detour leads answer without it."""
        there = {contact.node_id for contact in self._overlay.contacts() if contact.address in self._ways}
        now = self._clock.seconds()
        if not there:
            self._tries, self._next_at = 0, float("inf")
        elif self._next_at == float("inf"):
            self._next_at = now + AGAIN_S[0]
        elif now >= self._next_at:
            self._tries += 1
            self._next_at = now + AGAIN_S[min(self._tries, len(AGAIN_S) - 1)]
            for address in self._known:
                self._chores.fork(self._straight(address, there))

    async def _straight(self, address: Address, there: set[bytes]) -> None:
        found = await self._endpoint.greet(address, DIRECT_S)
        if found.node_id in there:
            self._log.info("{address} answers without a detour again", address=address)
            self._endpoint.reopen(found)
