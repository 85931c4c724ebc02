"""Outlet: where an emulator's bytes leave, with the faults that its switches say; and what says them to any number."""

from __future__ import annotations

import random
from typing import Generic, TypeVar

from twisted.internet.interfaces import IReactorTime

from drivers.link import Link
from drivers.timer import Timer
from middleware.faults.stream import StreamFaults
from sim.robots.emulator.body import Body


class Outlet:
    """One link to a driver, or none; what is sent without one is lost."""

    def __init__(self, clock: IReactorTime, rng: random.Random, faults: StreamFaults, link: Link | None = None) -> None:
        self.link = link
        self._clock = clock
        self._rng = rng
        self._faults = faults

    def send(self, data: bytes) -> None:
        """Send ``data``, or what is left of it."""
        for piece in self._faults.wire(data, self._rng):
            if self._faults.delay > 0.0:
                self._clock.callLater(self._faults.delay, self._leave, piece)
            else:
                self._leave(piece)

    def _leave(self, data: bytes) -> None:
        if self.link is not None:
            self.link.send(data)


class Client:
    """A client of ``device``; what it says is not heard."""

    def __init__(self, device: Broadcast[Client], link: Link, outlet: Outlet) -> None:
        self.link = link
        self.outlet = outlet
        self._device = device

    def received(self, data: bytes) -> None:
        """Hear nothing."""

    def link_down(self) -> None:
        """The client has gone."""
        self.outlet.link = None
        if self in self._device.clients:
            self._device.clients.remove(self)


AnyClient = TypeVar("AnyClient", bound=Client)


class Broadcast(Generic[AnyClient]):
    """A device that says something ``rate`` times a second (``_tell``) to ``clients``; ``faults`` spoils what it says.

    ``accept`` takes a client, any number.
    """

    make_client: type[AnyClient]

    def __init__(self, clock: IReactorTime, body: Body, rate: float) -> None:
        self.faults = StreamFaults()
        self.clients: list[AnyClient] = []
        self._clock = clock
        self._body = body
        self._interval = 1.0 / rate
        self._rng = random.Random(0)
        self._due = 0.0
        self._timer = Timer(clock)

    def accept(self, link: Link) -> AnyClient:
        """Take a client."""
        client = self.make_client(self, link, Outlet(self._clock, self._rng, self.faults, link))  # type: ignore[arg-type]
        self.clients.append(client)
        return client

    def start(self) -> None:
        """Switch it on; does nothing while it is on."""
        if not self._timer.is_set:
            self._due = self._clock.seconds() + self._interval
            self._timer.set(self._interval, self._beat)

    def stop(self) -> None:
        """Switch it off: every link breaks, and nothing is left on the clock."""
        self._timer.cancel()
        for client in list(self.clients):
            client.link.close()

    def _tell(self) -> None:
        raise NotImplementedError

    def _beat(self) -> None:
        # Counted from the beginning, so that late turns of the clock do not add up.
        now = self._clock.seconds()
        self._due = max(self._due + self._interval, now)
        self._timer.set(self._due - now, self._beat)
        self._tell()
