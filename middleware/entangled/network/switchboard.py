"""Switchboard: the networks of many nodes in one process, with weather and cuts on purpose.

It is the twin of ``udp``: the same interface, no socket.  Whatever happens here follows from the clock, the dice and
the order of sending, so a run can be replayed from its seed; ``digest`` tells whether two runs were the same.
"""

from __future__ import annotations

import hashlib
import random
import struct
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Protocol

from twisted.internet.interfaces import IReactorTime

from middleware.entangled.bounded import keep
from middleware.entangled.errors import PortInUse
from middleware.entangled.network.nat import Nat
from middleware.entangled.network.network import MAX_CARRIED, MAX_LED, Address, Receiver

_FIRST_FREE_PORT = 49152
_BATCH = 256
"""Deliveries that are hashed at once; a hash object is slower to ask often than to feed much."""
_MAX_NAMES = 50_000


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


class Link(Protocol):
    """What lies between all nodes of a board where weather is too plain: distances, bursts, queues.

    One object for the whole board: pairs are too many to have one each, so its state is that of senders and receivers.
    """

    def delays(self, source: Address, to: Address, size: int, now: float, rng: random.Random) -> Sequence[float]:
        """The seconds that each copy of a datagram of ``size`` bytes takes, sent at ``now``; none: it is lost."""


Barrier = Callable[[Address, Address], bool]
"""Whether nothing passes from the first to the second."""


class Traffic:
    """What one port has sent and taken in: datagrams, and their bytes."""

    __slots__ = ("sent", "sent_bytes", "received", "received_bytes")

    def __init__(self) -> None:
        self.sent = self.sent_bytes = self.received = self.received_bytes = 0


class SwitchboardNetwork:
    """One node's port on a ``Switchboard``; a ``Network`` and ``Ports``.  ``home`` is the router that it is behind.

    ``traffic`` counts what passes here; it may go on from a former life.
    """

    def __init__(
        self, board: Switchboard, address: Address, home: Nat | None = None, traffic: Traffic | None = None
    ) -> None:
        self._board = board
        self._address = address
        self._led: dict[Address, int] = {}
        self.traffic = Traffic() if traffic is None else traffic
        self.home = home
        self.further: set[int] = set()
        self.receiver: Receiver | None = None
        self.is_unplugged = False

    @property
    def address(self) -> Address:
        """The node's own address."""
        return self._address

    def listen(self, receiver: Receiver) -> None:
        """Open the port and hand each datagram to ``receiver``; raises ``PortInUse`` where another holds it."""
        self._board._plug(self, self._address)
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
        for port in list(self.further):
            self.shut_port(port)
        self._board._release(self, self._address)

    def open_port(self) -> int:
        """A further local port."""
        port = self._board._free_port(self._address.host, self.home)
        self.further.add(port)
        self._board._plug(self, self._address._replace(port=port))
        return port

    def shut_port(self, port: int) -> None:
        """Close a further port."""
        self.further.discard(port)
        self._led = {to: by for to, by in self._led.items() if by != port}
        self._board._release(self, self._address._replace(port=port))

    def lead(self, to: Address, port: int) -> int:
        """Let what goes to ``to`` leave by ``port``; 0: by the first one."""
        before = self._led.get(to, 0)
        keep(self._led, to, port if port in self.further else 0, MAX_LED)
        return before

    def local(self, to: Address, port: int = 0) -> Address:
        """The own address, before any translation."""
        return self._address._replace(port=port) if port else self._source(to)

    def hosts(self) -> list[str]:
        """The own address."""
        return [self._address.host]

    def _source(self, to: Address) -> Address:
        port = self._led.get(to) if self._led else 0
        return self._address._replace(port=port) if port else self._address

    def _came(self, datagram: bytes, source: Address, port: int) -> None:
        if port != self._address.port and source not in self._led:
            self.lead(source, port)
        if self.receiver is not None:
            self.traffic.received += 1
            self.traffic.received_bytes += len(datagram)
            self.receiver(datagram, source)


class Switchboard:
    """Joins the networks of one process; ``weather`` is the weather of every link that has none of its own.

    With a ``link`` that one says how long a datagram takes, unless two addresses have a weather of their own.  Nothing
    passes where one of the ``barriers`` stands.

    ``counters`` counts the datagrams that were sent, delivered, lost, cut, duplicated, unheard (nobody listens there),
    unsent (the sender is closed or unplugged), blocked (by a router) and oversized.
    """

    def __init__(self, clock: IReactorTime, rng: random.Random, weather: Weather = CALM) -> None:
        self.weather = weather
        self.link: Link | None = None
        self.barriers: list[Barrier] = []
        self.counters: Counter[str] = Counter()
        self._clock = clock
        self._rng = rng
        self._ports: dict[tuple[Nat | None, Address], SwitchboardNetwork] = {}
        self._routers: dict[str, Nat] = {}
        self.router_weather: dict[Nat, Weather] = {}
        self._links: dict[tuple[Address, Address], Weather] = {}
        self._cuts: set[tuple[Address, Address]] = set()
        self._sides: dict[Address, int] = {}
        self._next_port = _FIRST_FREE_PORT
        self._trace = hashlib.blake2b(digest_size=32)
        self._untraced: list[bytes] = []
        self._names: dict[Address, str] = {}

    def network(
        self, host: str = "127.0.0.1", port: int = 0, home: Nat | None = None, traffic: Traffic | None = None
    ) -> SwitchboardNetwork:
        """A new network at that address, behind the router ``home``; port 0 takes the next free one."""
        return SwitchboardNetwork(self, Address(host, port or self._free_port(host, home)), home, traffic)

    def router(self, nat: Nat, weather: Weather = CALM) -> Nat:
        """Put a router on the board; ``weather`` is met by all that passes it, besides that of the link."""
        self._routers[nat.host] = nat
        self.router_weather[nat] = weather
        return nat

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
        """Take back every cut, partition and barrier; weather stays, and so do the dead."""
        self._cuts.clear()
        self._sides.clear()
        self.barriers.clear()

    def kill(self, address: Address) -> None:
        """Unplug whoever listens at ``address`` without a word to it; a new network may take the address."""
        network = self._ports.pop((None, address), None)
        if network is not None:
            network.is_unplugged = True

    def digest(self) -> str:
        """The running hash, in hex, over (time, from, to, datagram) of every delivery so far."""
        self._hash()
        return self._trace.hexdigest()

    def _free_port(self, host: str, home: Nat | None) -> int:
        while True:
            port = self._next_port
            self._next_port += 1
            if self._next_port > 65535:
                self._next_port = _FIRST_FREE_PORT
            if (home, Address(host, port)) not in self._ports:
                return port

    def _plug(self, network: SwitchboardNetwork, address: Address) -> None:
        holder = self._ports.get((network.home, address))
        if holder is not None and holder is not network:
            raise PortInUse(f"{address}: another network listens there; take another port, or 0 for any")
        network.is_unplugged = False
        self._ports[network.home, address] = network

    def _release(self, network: SwitchboardNetwork, address: Address) -> None:
        if self._ports.get((network.home, address)) is network:
            del self._ports[network.home, address]

    def _passes(self, source: Address, to: Address) -> bool:
        if self._cuts and (source, to) in self._cuts:
            return False
        if self._sides and self._sides.get(source, 0) != self._sides.get(to, 0):
            return False
        return not any(barrier(source, to) for barrier in self.barriers) if self.barriers else True

    def _carry(self, network: SwitchboardNetwork, datagram: bytes, to: Address) -> None:
        self.counters["sent"] += 1
        network.traffic.sent += 1
        network.traffic.sent_bytes += len(datagram)
        source = network._source(to)
        if len(datagram) > MAX_CARRIED:
            self.counters["oversized"] += 1
            return
        home = network.home
        if home is not None:
            if (home, to) in self._ports:
                self._clock.callLater(0.0, self._hand, home, to, source, to, datagram)
                return
            outside = home.out(source, to, self._clock.seconds()) if to.host != home.host else None
            if outside is None:
                self.counters["blocked"] += 1
                return
            source = outside
        if not self._passes(source, to):
            self.counters["cut"] += 1
            return
        own = self._links.get((source, to)) if self._links else None
        weather = own or self.weather
        routers = (home, self._routers.get(to.host)) if self._routers else ()
        further = [self.router_weather[router] for router in routers if router is not None] if routers else []
        delays: Sequence[float]
        if self.link is not None and own is None:
            delays = self.link.delays(source, to, len(datagram), self._clock.seconds(), self._rng)
        elif weather is CALM and not further:
            self._clock.callLater(0.0, self._deliver, source, to, datagram)
            return
        else:
            delays = weather.delays(self._rng)
        for each in further:
            delays = [delay + more for delay in delays for more in each.delays(self._rng)]
        if len(delays) != 1:
            self.counters["duplicated" if delays else "lost"] += 1
        for delay in delays:
            self._clock.callLater(delay, self._deliver, source, to, datagram)

    def _deliver(self, source: Address, to: Address, datagram: bytes) -> None:
        if not self._passes(source, to):
            self.counters["cut"] += 1
            return
        router = self._routers.get(to.host) if self._routers else None
        if router is None:
            self._hand(None, to, source, to, datagram)
            return
        inner = router.into(source, to.port, self._clock.seconds())
        if inner is None:
            self.counters["blocked"] += 1
        else:
            self._hand(router, inner, source, to, datagram)

    def _hand(self, home: Nat | None, at: Address, source: Address, to: Address, datagram: bytes) -> None:
        """Hand a datagram to whoever listens ``at`` an address behind ``home``."""
        network = self._ports.get((home, at))
        if network is None or network.receiver is None:
            self.counters["unheard"] += 1
            return
        self.counters["delivered"] += 1
        names = self._names
        here = names.get(source) or self._named(source)
        there = names.get(to) or self._named(to)
        route = f"{here}>{there} {len(datagram)}:".encode()
        self._untraced += (struct.pack("<d", self._clock.seconds()), route, datagram)
        if len(self._untraced) > 3 * _BATCH:
            self._hash()
        network._came(datagram, source, at.port)

    def _named(self, address: Address) -> str:
        if len(self._names) > _MAX_NAMES:
            self._names.clear()
        name = self._names[address] = str(address)
        return name

    def _hash(self) -> None:
        self._trace.update(b"".join(self._untraced))
        self._untraced.clear()
