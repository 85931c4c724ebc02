"""Broadcast: a device that says something at a steady rate to whoever listens, any number of clients."""

from __future__ import annotations

import random
from typing import Any, Generic, Protocol, TypeVar

from twisted.internet.interfaces import IReactorTime

from drivers.link import Link
from middleware.faults.stream import StreamFaults
from sim.robots.emulator.body import Body


class Listener(Protocol):
    """One client."""

    link: Link


Client = TypeVar("Client", bound=Listener)


class Broadcast(Generic[Client]):
    """What emulated cameras and compasses share: ``clients``, and a beat of ``rate`` a second for ``_tell``.

    ``faults`` spoils what it says.
    """

    def __init__(
        self, clock: IReactorTime, body: Body, rate: float, rng: random.Random | None, faults: StreamFaults | None
    ) -> None:
        self.faults = StreamFaults() if faults is None else faults
        self.clients: list[Client] = []
        self._clock = clock
        self._body = body
        self._interval = 1.0 / rate
        self._rng = random.Random(0) if rng is None else rng
        self._due = 0.0
        self._timer: Any = None

    def start(self) -> None:
        """Switch it on; does nothing while it is on."""
        if self._timer is None:
            self._due = self._clock.seconds() + self._interval
            self._timer = self._clock.callLater(self._interval, self._beat)

    def stop(self) -> None:
        """Switch it off: every link breaks, and nothing is left on the clock."""
        if self._timer is not None:
            self._timer.cancel()
        self._timer = None
        for client in list(self.clients):
            client.link.close()

    def leave(self, client: Client) -> None:
        """A client has gone; called by it."""
        if client in self.clients:
            self.clients.remove(client)

    def _tell(self) -> None:
        raise NotImplementedError

    def _beat(self) -> None:
        # Counted from the beginning, so that late turns of the clock do not add up.
        now = self._clock.seconds()
        self._due = max(self._due + self._interval, now)
        self._timer = self._clock.callLater(self._due - now, self._beat)
        self._tell()
