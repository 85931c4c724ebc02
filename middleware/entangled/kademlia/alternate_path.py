"""Enter the network through a tunnel when UDP is blocked, and return to UDP as soon as it works.

A tunnel uses memory of the serving node and delays datagrams.  Therefore a node opens a tunnel only if no known node
answers over UDP, and abandons it as soon as the serving node answers over UDP.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Coroutine, Sequence
from typing import Any

from twisted.internet.defer import Deferred, DeferredList, FirstError
from twisted.internet.interfaces import IReactorTime
from twisted.logger import Logger

from middleware.entangled.background import Background, gather_first
from middleware.entangled.contact import Contact
from middleware.entangled.errors import NoAnswer
from middleware.entangled.kademlia.overlay import Overlay
from middleware.entangled.network.network import Address
from middleware.entangled.wire.endpoint import Endpoint

FALLBACK_AFTER_S = 1.5
"""The seconds in which the known nodes may answer over UDP before a tunnel is tried."""
TUNNEL_TIMEOUT_S = 4.0
"""The timeout of a discovery request through a tunnel in seconds: it includes DNS, TCP, TLS and WebSocket."""
BACKOFF_S = (0.2, 0.8)
"""The shortest and longest pause in seconds between two tries; the tunnel network itself limits the rate of
dialling."""
DIRECT_RETRY_INTERVALS_S = (5.0, 15.0, 60.0)
"""The seconds between the attempts to return to UDP; the last interval repeats."""
CHECK_INTERVAL_S = 1.0
DIRECT_TIMEOUT_S = 0.5
"""The timeout of a discovery request over UDP in seconds; a reachable node answers in one round trip."""

Enter = Callable[[Contact], Coroutine[Any, Any, None]]


class AlternatePaths:
    """The tunnels of one node; ``enter`` authenticates a discovered contact and exchanges members with it."""

    _log = Logger()

    def __init__(
        self,
        overlay: Overlay,
        endpoint: Endpoint,
        clock: IReactorTime,
        rng: random.Random,
        background: Background,
        enter: Enter,
    ) -> None:
        self._overlay = overlay
        self._endpoint = endpoint
        self._clock = clock
        self._rng = rng
        self._background = background
        self._enter = enter
        self._tunnels: tuple[Address, ...] = ()
        self._known: tuple[Address, ...] = ()
        self._tries = 0
        self._next_at = float("inf")

    @property
    def is_configured(self) -> bool:
        """Whether any tunnel is configured."""
        return bool(self._tunnels)

    def configure(self, tunnels: Sequence[Address], known: Sequence[Address]) -> None:
        """Set the tunnels, and the addresses of known nodes to return to over UDP; called once."""
        self._tunnels, self._known = tuple(tunnels), tuple(known)
        if tunnels:
            self._background.every(CHECK_INTERVAL_S, self._try_direct)

    async def enter_with_fallback(self, join: Coroutine[Any, Any, None] | None) -> None:
        """Enter the network by ``join``, or by a tunnel if ``join`` takes too long; None: only by a tunnel.

        Returns when one of the two has succeeded.
        """
        begun = [] if join is None else [Deferred.fromCoroutine(join)]
        try:
            await DeferredList(
                [
                    *begun,
                    Deferred.fromCoroutine(self._try_repeatedly(0.0 if join is None else FALLBACK_AFTER_S, begun)),
                ],
                fireOnOneCallback=True,
                fireOnOneErrback=True,
                consumeErrors=True,
            )
        except FirstError as error:
            error.subFailure.raiseException()

    async def try_once(self) -> bool:
        """Return whether a node of the team answers through any tunnel; return after the first answer."""
        return bool(await gather_first(1, [self._enter_by(tunnel) for tunnel in self._tunnels]))

    # -- private ----------------------------------------------------------------------------------------------------

    async def _try_repeatedly(self, wait: float, others: Sequence[Deferred[None]]) -> None:
        """Try all tunnels repeatedly, until this node has entered the network by a tunnel or a different path."""
        pause = BACKOFF_S[0]
        while True:
            if wait:
                await self._background.sleep(wait)
            if any(other.called for other in others) or await self.try_once():
                return
            wait = pause * (0.75 + self._rng.random() / 2)
            pause = min(pause * 2, BACKOFF_S[1])

    async def _enter_by(self, address: Address) -> bool:
        contact = await self._endpoint.discover(address, TUNNEL_TIMEOUT_S)
        if contact.node_id == self._overlay.own_id:
            raise NoAnswer(f"{address} is the address of this node itself")
        await self._enter(contact)
        return True

    def _try_direct(self) -> None:
        """Check at growing intervals whether the nodes behind tunnels answer over UDP."""
        tunnelled = {contact.node_id for contact in self._overlay.contacts() if contact.address in self._tunnels}
        now = self._clock.seconds()
        if not tunnelled:
            self._tries, self._next_at = 0, float("inf")
        elif self._next_at == float("inf"):
            self._next_at = now + DIRECT_RETRY_INTERVALS_S[0]
        elif now >= self._next_at:
            self._tries += 1
            self._next_at = now + DIRECT_RETRY_INTERVALS_S[min(self._tries, len(DIRECT_RETRY_INTERVALS_S) - 1)]
            for address in self._known:
                self._background.fork(self._reopen_direct(address, tunnelled))

    async def _reopen_direct(self, address: Address, tunnelled: set[bytes]) -> None:
        found = await self._endpoint.discover(address, DIRECT_TIMEOUT_S)
        if found.node_id in tunnelled:
            self._log.info("{address} is reachable over UDP again", address=address)
            self._endpoint.reopen(found)
