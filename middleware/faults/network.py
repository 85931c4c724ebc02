"""Faults of one node's datagrams: loss, delay, duplicates, and silence in one direction or both.

``FaultyNetwork`` wraps any other ``Network``.  It does at the port of a real node the same as the switchboard does
between simulated ones.  Initially it changes nothing.
"""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Callable

from twisted.internet.interfaces import IReactorTime

from middleware.entangled.network.network import Address, Network, Ports, Receiver, detours_of, ports_of
from middleware.entangled.network.switchboard import CALM


class FaultyNetwork:
    """``network`` with faults.

    ``weather`` applies to each datagram sent and to each one received, so to a request and its response twice.
    ``is_deaf``: nothing is received; ``is_mute``: nothing is sent.  ``eaten`` counts the datagrams that were silenced,
    lost and duplicated.
    """

    def __init__(self, network: Network, clock: IReactorTime, rng: random.Random) -> None:
        self.weather = CALM
        self.is_deaf = False
        self.is_mute = False
        self.eaten: Counter[str] = Counter()
        self._network = network
        self._clock = clock
        self._rng = rng
        self._receiver: Receiver | None = None

    @property
    def address(self) -> Address:
        """The node's own address."""
        return self._network.address

    @property
    def ports(self) -> Ports | None:
        """The local ports of the network."""
        return ports_of(self._network)

    @property
    def detours(self) -> list[Address]:
        """The ways around of the network."""
        return detours_of(self._network)

    def listen(self, receiver: Receiver) -> None:
        """Open the port and hand on what gets through; raises ``PortInUse`` where another holds it."""
        self._network.listen(self._came)
        self._receiver = receiver

    def send(self, datagram: bytes, to: Address) -> None:
        """Send what gets through."""
        if self.is_mute:
            self.eaten["silenced"] += 1
        elif self.weather is CALM:
            self._network.send(datagram, to)
        else:
            self._suffer(self._sent, datagram, to)

    def close(self) -> None:
        """Close the port, what is on its way is lost; may be called twice."""
        self._receiver = None
        self._network.close()

    def _came(self, datagram: bytes, source: Address) -> None:
        if self.is_deaf:
            self.eaten["silenced"] += 1
        elif self.weather is CALM:
            self._heard(datagram, source)
        else:
            self._suffer(self._heard, datagram, source)

    def _suffer(self, go_on: Receiver, datagram: bytes, address: Address) -> None:
        delays = self.weather.delays(self._rng)
        if len(delays) != 1:
            self.eaten["duplicated" if delays else "lost"] += 1
        for delay in delays:
            self._after(delay, lambda: go_on(datagram, address))

    def _after(self, delay: float, act: Callable[[], None]) -> None:
        if delay > 0.0:
            self._clock.callLater(delay, act)
        else:
            act()

    def _sent(self, datagram: bytes, to: Address) -> None:
        if self._receiver is not None and not self.is_mute:
            self._network.send(datagram, to)

    def _heard(self, datagram: bytes, source: Address) -> None:
        if self._receiver is not None and not self.is_deaf:
            self._receiver(datagram, source)
