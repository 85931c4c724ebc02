"""Output of emulators with fault injection, and a base class for devices that send to several clients."""

from __future__ import annotations

import random
from typing import Generic, TypeVar

from twisted.internet.interfaces import IReactorTime

from drivers.link import Link
from drivers.timer import Timer
from middleware.faults.stream import StreamFaults
from sim.robots.emulator.simulated_robot import SimulatedRobot


class FaultyOutput:
    """The output to a driver: one link, or none, in which case data is lost."""

    def __init__(self, clock: IReactorTime, rng: random.Random, faults: StreamFaults, link: Link | None = None) -> None:
        self.link = link
        self._clock = clock
        self._rng = rng
        self._faults = faults

    def send(self, data: bytes) -> None:
        """Send ``data``, subject to the injected faults."""
        for piece in self._faults.apply(data, self._rng):
            if self._faults.delay > 0.0:
                self._clock.callLater(self._faults.delay, self._send_now, piece)
            else:
                self._send_now(piece)

    def _send_now(self, data: bytes) -> None:
        if self.link is not None:
            self.link.send(data)


class Client:
    """A client of ``device``; its data is ignored."""

    def __init__(self, device: Broadcast[Client], link: Link, output: FaultyOutput) -> None:
        self.link = link
        self.output = output
        self._device = device

    def data_received(self, data: bytes) -> None:
        """Ignore the data."""

    def link_down(self) -> None:
        """Remove the client from the device."""
        self.output.link = None
        if self in self._device.clients:
            self._device.clients.remove(self)


AnyClient = TypeVar("AnyClient", bound=Client)


class Broadcast(Generic[AnyClient]):
    """A device that sends data ``rate`` times per second (``_broadcast``) to ``clients``; ``faults`` corrupts the data.

    ``accept`` adds a client.
    """

    make_client: type[AnyClient]

    def __init__(self, clock: IReactorTime, robot: SimulatedRobot, rate: float) -> None:
        self.faults = StreamFaults()
        self.clients: list[AnyClient] = []
        self._clock = clock
        self._robot = robot
        self._interval = 1.0 / rate
        self._rng = random.Random(0)
        self._due = 0.0
        self._timer = Timer(clock)

    def accept(self, link: Link) -> AnyClient:
        """Add a client."""
        client = self.make_client(self, link, FaultyOutput(self._clock, self._rng, self.faults, link))  # type: ignore[arg-type]
        self.clients.append(client)
        return client

    def start(self) -> None:
        """Start to send; does nothing if already started."""
        if not self._timer.is_set:
            self._due = self._clock.seconds() + self._interval
            self._timer.set(self._interval, self._on_time)

    def stop(self) -> None:
        """Stop: close every link and cancel the timer."""
        self._timer.cancel()
        for client in list(self.clients):
            client.link.close()

    def _broadcast(self) -> None:
        raise NotImplementedError

    def _on_time(self) -> None:
        # Due times are computed from the start time, so delays do not accumulate.
        now = self._clock.seconds()
        self._due = max(self._due + self._interval, now)
        self._timer.set(self._due - now, self._on_time)
        self._broadcast()
