"""Simulate the datagram networks of many nodes in one process, with delay, loss and partitions.

The switchboard's networks have the same interface as ``udp``, but use no sockets.  The behaviour depends only on the
clock, the random generator and the order of sending, so a run can be reproduced from its seed.  Two runs are identical
if their ``digest`` is equal.
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

from middleware.entangled.bounded import put_bounded
from middleware.entangled.errors import PortInUse
from middleware.entangled.network.nat_router import NatRouter
from middleware.entangled.network.network import MAX_ASSIGNED, MAX_RELAYED_BYTES, Address, Receiver

_FIRST_FREE_PORT = 49152
_TRACE_BATCH = 256
"""The number of deliveries that are hashed together, because one large update is faster than many small ones."""
_MAX_NAMES = 50_000


@dataclass(frozen=True)
class LinkConditions:
    """The conditions of a link.

    Each datagram takes ``delay_s``, plus or minus up to ``jitter_s`` (uniform), at least 0.  ``loss``, ``duplicate``
    and ``reorder`` are probabilities from 0 to 1; a reordered datagram is delayed by a further ``delay_s`` plus 1 ms.
    """

    delay_s: float = 0.0
    jitter_s: float = 0.0
    loss: float = 0.0
    duplicate: float = 0.0
    reorder: float = 0.0

    def draw_delays(self, rng: random.Random) -> list[float]:
        """Return the delay in seconds of each copy of one datagram: none if it is lost, two if it is duplicated."""
        if self.loss and rng.random() < self.loss:
            return []
        copies = 2 if self.duplicate and rng.random() < self.duplicate else 1
        return [self._draw_delay(rng) for _ in range(copies)]

    def _draw_delay(self, rng: random.Random) -> float:
        delay = self.delay_s
        if self.jitter_s:
            delay = max(0.0, delay + rng.uniform(-self.jitter_s, self.jitter_s))
        if self.reorder and rng.random() < self.reorder:
            delay += self.delay_s + 0.001
        return delay


PERFECT = LinkConditions()


class LinkModel(Protocol):
    """A model of the links between all nodes, for distances, bursts and queues.

    One object serves the whole switchboard, because there would be too many pairs for an object per link.  It stores
    state per sender and per receiver.
    """

    def draw_delays(self, source: Address, to: Address, size: int, now: float, rng: random.Random) -> Sequence[float]:
        """Return the delay in seconds of each copy of a datagram of ``size`` bytes sent at ``now``; empty if lost."""


Barrier = Callable[[Address, Address], bool]
"""Returns whether datagrams from the first address to the second are blocked."""


class TrafficCounters:
    """The datagrams and bytes that one port has sent and received."""

    __slots__ = ("sent", "sent_bytes", "received", "received_bytes")

    def __init__(self) -> None:
        self.sent = self.sent_bytes = self.received = self.received_bytes = 0


class SwitchboardNetwork:
    """One node's port on a ``Switchboard``, behind the router ``router``; a ``Network`` with ``LocalPorts``.

    ``traffic`` counts the datagrams of the port; the counters may be passed on to the port of a restarted node.
    """

    def __init__(
        self,
        switchboard: Switchboard,
        address: Address,
        router: NatRouter | None = None,
        traffic: TrafficCounters | None = None,
    ) -> None:
        self._switchboard = switchboard
        self._address = address
        self._port_by_target: dict[Address, int] = {}
        self.traffic = TrafficCounters() if traffic is None else traffic
        self.router = router
        self.additional_ports: set[int] = set()
        self.receiver: Receiver | None = None
        self.is_unplugged = False

    @property
    def address(self) -> Address:
        """The node's address."""
        return self._address

    def listen(self, receiver: Receiver) -> None:
        """Open the port and pass each datagram to ``receiver``; raises ``PortInUse`` if the port is in use."""
        self._switchboard._register(self, self._address)
        self.receiver = receiver

    def send(self, datagram: bytes, to: Address) -> None:
        """Send a datagram; a datagram that cannot be sent is lost."""
        if self.receiver is None or self.is_unplugged:
            self._switchboard.counters["unsent"] += 1
        else:
            self._switchboard._transmit(self, datagram, to)

    def close(self) -> None:
        """Close the port; may be called twice."""
        self.receiver = None
        for port in list(self.additional_ports):
            self.close_port(port)
        self._switchboard._release(self, self._address)

    def open_port(self) -> int:
        """Open an additional local port and return it."""
        port = self._switchboard._free_port(self._address.host, self.router)
        self.additional_ports.add(port)
        self._switchboard._register(self, self._address._replace(port=port))
        return port

    def close_port(self, port: int) -> None:
        """Close an additional port."""
        self.additional_ports.discard(port)
        self._port_by_target = {to: by for to, by in self._port_by_target.items() if by != port}
        self._switchboard._release(self, self._address._replace(port=port))

    def assign_port(self, to: Address, port: int) -> int:
        """Assign ``port`` to the target ``to``; 0 is the listening port."""
        before = self._port_by_target.get(to, 0)
        put_bounded(self._port_by_target, to, port if port in self.additional_ports else 0, MAX_ASSIGNED)
        return before

    def source_address(self, to: Address, port: int = 0) -> Address:
        """Return the node's address, before any translation."""
        return self._address._replace(port=port) if port else self._source(to)

    def local_hosts(self) -> list[str]:
        """Return the node's host."""
        return [self._address.host]

    def _source(self, to: Address) -> Address:
        port = self._port_by_target.get(to) if self._port_by_target else 0
        return self._address._replace(port=port) if port else self._address

    def _receive(self, datagram: bytes, source: Address, port: int) -> None:
        if port != self._address.port and source not in self._port_by_target:
            self.assign_port(source, port)
        if self.receiver is not None:
            self.traffic.received += 1
            self.traffic.received_bytes += len(datagram)
            self.receiver(datagram, source)


class Switchboard:
    """Connects the networks of one process; ``conditions`` applies to every link that has no separate conditions.

    If a ``link`` model is given, it determines the delays instead of ``conditions``.  Each of the ``barriers`` may
    block datagrams.

    ``counters`` counts the datagrams that were sent, delivered, lost, cut, duplicated, unheard (no listener at the
    address), unsent (the sender is closed or unplugged), blocked (by a router) and oversized.
    """

    def __init__(self, clock: IReactorTime, rng: random.Random, conditions: LinkConditions = PERFECT) -> None:
        self.conditions = conditions
        self.link_model: LinkModel | None = None
        self.barriers: list[Barrier] = []
        self.counters: Counter[str] = Counter()
        self._clock = clock
        self._rng = rng
        self._ports: dict[tuple[NatRouter | None, Address], SwitchboardNetwork] = {}
        self._routers: dict[str, NatRouter] = {}
        self.router_conditions: dict[NatRouter, LinkConditions] = {}
        self._links: dict[tuple[Address, Address], LinkConditions] = {}
        self._cuts: set[tuple[Address, Address]] = set()
        self._sides: dict[Address, int] = {}
        self._next_port = _FIRST_FREE_PORT
        self._trace = hashlib.blake2b(digest_size=32)
        self._untraced: list[bytes] = []
        self._names: dict[Address, str] = {}

    def make_network(
        self,
        host: str = "127.0.0.1",
        port: int = 0,
        home: NatRouter | None = None,
        traffic: TrafficCounters | None = None,
    ) -> SwitchboardNetwork:
        """Create a network at that address, behind the router ``home``; port 0 selects the next free port."""
        return SwitchboardNetwork(self, Address(host, port or self._free_port(host, home)), home, traffic)

    def add_router(self, nat: NatRouter, conditions: LinkConditions = PERFECT) -> NatRouter:
        """Add a router; ``conditions`` applies to all datagrams through it, in addition to the link's."""
        self._routers[nat.host] = nat
        self.router_conditions[nat] = conditions
        return nat

    def set_conditions(self, a: Address, b: Address, conditions: LinkConditions | None, one_way: bool = False) -> None:
        """Set the conditions of the link between ``a`` and ``b`` (or from ``a`` to ``b``); None resets them."""
        for link in [(a, b)] if one_way else [(a, b), (b, a)]:
            if conditions is None:
                self._links.pop(link, None)
            else:
                self._links[link] = conditions

    def cut(self, a: Address, b: Address, one_way: bool = False) -> None:
        """Block datagrams between ``a`` and ``b`` (or from ``a`` to ``b``), including those in flight."""
        self._cuts.add((a, b))
        if not one_way:
            self._cuts.add((b, a))

    def partition(self, *groups: Iterable[Address]) -> None:
        """Block datagrams between ``groups``; all addresses that are in no group form one further group."""
        self._sides = {address: number for number, group in enumerate(groups, start=1) for address in group}

    def heal(self) -> None:
        """Undo every cut, partition and barrier; link conditions and killed nodes stay."""
        self._cuts.clear()
        self._sides.clear()
        self.barriers.clear()

    def kill(self, address: Address) -> None:
        """Unplug the network at ``address`` without notification; a new network may use the same address."""
        network = self._ports.pop((None, address), None)
        if network is not None:
            network.is_unplugged = True

    def digest(self) -> str:
        """Return a hash, in hex, of (time, from, to, datagram) of all deliveries since the start."""
        self._hash_trace()
        return self._trace.hexdigest()

    def _free_port(self, host: str, home: NatRouter | None) -> int:
        while True:
            port = self._next_port
            self._next_port += 1
            if self._next_port > 65535:
                self._next_port = _FIRST_FREE_PORT
            if (home, Address(host, port)) not in self._ports:
                return port

    def _register(self, network: SwitchboardNetwork, address: Address) -> None:
        holder = self._ports.get((network.router, address))
        if holder is not None and holder is not network:
            raise PortInUse(f"{address}: the port is in use; choose another port, or 0 for any")
        network.is_unplugged = False
        self._ports[network.router, address] = network

    def _release(self, network: SwitchboardNetwork, address: Address) -> None:
        if self._ports.get((network.router, address)) is network:
            del self._ports[network.router, address]

    def _is_connected(self, source: Address, to: Address) -> bool:
        if self._cuts and (source, to) in self._cuts:
            return False
        if self._sides and self._sides.get(source, 0) != self._sides.get(to, 0):
            return False
        return not any(barrier(source, to) for barrier in self.barriers) if self.barriers else True

    def _transmit(self, network: SwitchboardNetwork, datagram: bytes, to: Address) -> None:
        self.counters["sent"] += 1
        network.traffic.sent += 1
        network.traffic.sent_bytes += len(datagram)
        source = network._source(to)
        if len(datagram) > MAX_RELAYED_BYTES:
            self.counters["oversized"] += 1
            return
        home = network.router
        if home is not None:
            if (home, to) in self._ports:
                self._clock.callLater(0.0, self._pass_to_listener, home, to, source, to, datagram)
                return
            outside = home.translate_outgoing(source, to, self._clock.seconds()) if to.host != home.host else None
            if outside is None:
                self.counters["blocked"] += 1
                return
            source = outside
        if not self._is_connected(source, to):
            self.counters["cut"] += 1
            return
        own = self._links.get((source, to)) if self._links else None
        conditions = own or self.conditions
        routers = (home, self._routers.get(to.host)) if self._routers else ()
        router_conditions = (
            [self.router_conditions[router] for router in routers if router is not None] if routers else []
        )
        delays: Sequence[float]
        if self.link_model is not None and own is None:
            delays = self.link_model.draw_delays(source, to, len(datagram), self._clock.seconds(), self._rng)
        elif conditions is PERFECT and not router_conditions:
            self._clock.callLater(0.0, self._deliver, source, to, datagram)
            return
        else:
            delays = conditions.draw_delays(self._rng)
        for each in router_conditions:
            delays = [delay + more for delay in delays for more in each.draw_delays(self._rng)]
        if len(delays) != 1:
            self.counters["duplicated" if delays else "lost"] += 1
        for delay in delays:
            self._clock.callLater(delay, self._deliver, source, to, datagram)

    def _deliver(self, source: Address, to: Address, datagram: bytes) -> None:
        if not self._is_connected(source, to):
            self.counters["cut"] += 1
            return
        router = self._routers.get(to.host) if self._routers else None
        if router is None:
            self._pass_to_listener(None, to, source, to, datagram)
            return
        inner = router.translate_incoming(source, to.port, self._clock.seconds())
        if inner is None:
            self.counters["blocked"] += 1
        else:
            self._pass_to_listener(router, inner, source, to, datagram)

    def _pass_to_listener(
        self, home: NatRouter | None, at: Address, source: Address, to: Address, datagram: bytes
    ) -> None:
        """Pass a datagram to the listener at an address behind ``home``."""
        network = self._ports.get((home, at))
        if network is None or network.receiver is None:
            self.counters["unheard"] += 1
            return
        self.counters["delivered"] += 1
        names = self._names
        source_name = names.get(source) or self._add_name(source)
        target_name = names.get(to) or self._add_name(to)
        route = f"{source_name}>{target_name} {len(datagram)}:".encode()
        self._untraced += (struct.pack("<d", self._clock.seconds()), route, datagram)
        if len(self._untraced) > 3 * _TRACE_BATCH:
            self._hash_trace()
        network._receive(datagram, source, at.port)

    def _add_name(self, address: Address) -> str:
        if len(self._names) > _MAX_NAMES:
            self._names.clear()
        name = self._names[address] = str(address)
        return name

    def _hash_trace(self) -> None:
        self._trace.update(b"".join(self._untraced))
        self._untraced.clear()
