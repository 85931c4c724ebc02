"""Switchboard: the networks of many nodes in one process, with weather and cuts on purpose.

It is the twin of ``udp``: the same interface, no socket.  Whatever happens here follows from the clock, the dice and
the order of sending, so a run can be replayed from its seed; ``digest`` tells whether two runs were the same.
"""

from __future__ import annotations

import hashlib
import random
import struct
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass

from twisted.internet.interfaces import IReactorTime

from middleware.entangled.errors import PortInUse
from middleware.entangled.network.network import MAX_DATAGRAM, Address, Receiver

_FIRST_FREE_PORT = 49152


@dataclass(frozen=True)
class Weather:
    """What a link does to datagrams.

    Each takes ``delay_s``, plus or minus up to ``jitter_s`` (even), never less than 0.  ``loss``, ``duplicate`` and
    ``reorder`` are probabilities from 0 to 1; a reordered datagram takes as long again and a millisecond more.
    """

    delay_s: float = 0.0
    jitter_s: float = 0.0
    loss: float = 0.0
    duplicate: float = 0.0
    reorder: float = 0.0

    def delays(self, rng: random.Random) -> list[float]:
        """The seconds that each copy of one datagram takes: none where it is lost, two where it is duplicated."""
        if self.loss and rng.random() < self.loss:
            return []
        copies = 2 if self.duplicate and rng.random() < self.duplicate else 1
        return [self._delay(rng) for _ in range(copies)]

    def _delay(self, rng: random.Random) -> float:
        delay = self.delay_s
        if self.jitter_s:
            delay = max(0.0, delay + rng.uniform(-self.jitter_s, self.jitter_s))
        if self.reorder and rng.random() < self.reorder:
            delay += self.delay_s + 0.001
        return delay


CALM = Weather()


class SwitchboardNetwork:
    """One node's port on a ``Switchboard``; a ``Network``."""

    def __init__(self, board: Switchboard, address: Address) -> None:
        self._board = board
        self._address = address
        self.receiver: Receiver | None = None
        self.is_unplugged = False

    @property
    def address(self) -> Address:
        """The node's own address."""
        return self._address

    def listen(self, receiver: Receiver) -> None:
        """Open the port and hand each datagram to ``receiver``; raises ``PortInUse`` where another holds it."""
        self._board._plug(self)
        self.receiver = receiver

    def send(self, datagram: bytes, to: Address) -> None:
        """Send a datagram; what cannot be sent is lost."""
        if self.receiver is None or self.is_unplugged:
            self._board.counters["unsent"] += 1
        else:
            self._board._carry(self, datagram, to)

    def close(self) -> None:
        """Close the port; may be called twice."""
        self.receiver = None
        self._board._release(self)


class Switchboard:
    """Joins the networks of one process; ``weather`` is the weather of every link that has none of its own.

    ``counters`` counts the datagrams that were sent, delivered, lost, cut, duplicated, unheard (nobody listens there),
    unsent (the sender is closed or unplugged) and oversized.
    """

    def __init__(self, clock: IReactorTime, rng: random.Random, weather: Weather = CALM) -> None:
        self.weather = weather
        self.counters: Counter[str] = Counter()
        self._clock = clock
        self._rng = rng
        self._ports: dict[Address, SwitchboardNetwork] = {}
        self._links: dict[tuple[Address, Address], Weather] = {}
        self._cuts: set[tuple[Address, Address]] = set()
        self._sides: dict[Address, int] = {}
        self._next_port = _FIRST_FREE_PORT
        self._trace = hashlib.blake2b(digest_size=32)

    def network(self, host: str = "127.0.0.1", port: int = 0) -> SwitchboardNetwork:
        """A new network at that address; port 0 takes the next free one."""
        while port == 0:
            if Address(host, self._next_port) not in self._ports:
                port = self._next_port
            self._next_port += 1
            if self._next_port > 65535:
                self._next_port = _FIRST_FREE_PORT
        return SwitchboardNetwork(self, Address(host, port))

    def set_weather(self, a: Address, b: Address, weather: Weather | None, one_way: bool = False) -> None:
        """Give the link between ``a`` and ``b`` (or from ``a`` to ``b``) a weather of its own; None takes it back."""
        for link in [(a, b)] if one_way else [(a, b), (b, a)]:
            if weather is None:
                self._links.pop(link, None)
            else:
                self._links[link] = weather

    def cut(self, a: Address, b: Address, one_way: bool = False) -> None:
        """Let nothing pass between ``a`` and ``b`` (or from ``a`` to ``b``), what is on its way included."""
        self._cuts.add((a, b))
        if not one_way:
            self._cuts.add((b, a))

    def partition(self, *groups: Iterable[Address]) -> None:
        """Let nothing pass from group to group; who is named in none forms one more group."""
        self._sides = {address: number for number, group in enumerate(groups, start=1) for address in group}

    def heal(self) -> None:
        """Take back every cut and partition; weather stays, and so do the dead."""
        self._cuts.clear()
        self._sides.clear()

    def kill(self, address: Address) -> None:
        """Unplug whoever listens at ``address`` without a word to it; a new network may take the address."""
        network = self._ports.pop(address, None)
        if network is not None:
            network.is_unplugged = True

    def digest(self) -> str:
        """The running hash, in hex, over (time, from, to, datagram) of every delivery so far."""
        return self._trace.hexdigest()

    def _plug(self, network: SwitchboardNetwork) -> None:
        holder = self._ports.get(network.address)
        if holder is not None and holder is not network:
            raise PortInUse(f"{network.address}: another network listens there; take another port, or 0 for any")
        network.is_unplugged = False
        self._ports[network.address] = network

    def _release(self, network: SwitchboardNetwork) -> None:
        if self._ports.get(network.address) is network:
            del self._ports[network.address]

    def _passes(self, source: Address, to: Address) -> bool:
        return (source, to) not in self._cuts and self._sides.get(source, 0) == self._sides.get(to, 0)

    def _carry(self, network: SwitchboardNetwork, datagram: bytes, to: Address) -> None:
        self.counters["sent"] += 1
        source = network.address
        if len(datagram) > MAX_DATAGRAM:
            self.counters["oversized"] += 1
            return
        if not self._passes(source, to):
            self.counters["cut"] += 1
            return
        weather = self._links.get((source, to), self.weather) if self._links else self.weather
        if weather is CALM:
            self._clock.callLater(0.0, self._deliver, source, to, datagram)
            return
        delays = weather.delays(self._rng)
        if len(delays) != 1:
            self.counters["duplicated" if delays else "lost"] += 1
        for delay in delays:
            self._clock.callLater(delay, self._deliver, source, to, datagram)

    def _deliver(self, source: Address, to: Address, datagram: bytes) -> None:
        if not self._passes(source, to):
            self.counters["cut"] += 1
            return
        network = self._ports.get(to)
        if network is None or network.receiver is None:
            self.counters["unheard"] += 1
            return
        self.counters["delivered"] += 1
        route = f"{source}>{to} {len(datagram)}:".encode()
        self._trace.update(struct.pack("<d", self._clock.seconds()) + route + datagram)
        network.receiver(datagram, source)
