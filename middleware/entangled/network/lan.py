"""Join the multicast group of the LAN on every interface, with IPv4 and IPv6.

Each address family has two ports: a receiving port, shared with the other nodes of this machine, and a sending port,
which also receives the replies.  Interfaces appear and disappear (a cable, a different Wi-Fi), so they are listed again
every ``LIST_INTERVAL_S`` seconds.
"""

from __future__ import annotations

import socket
import struct
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from twisted.internet.interfaces import IDelayedCall
from twisted.internet.protocol import DatagramProtocol
from twisted.logger import Logger

from middleware.entangled.background import cancel
from middleware.entangled.network.interface import Interface, list_interfaces, select_interfaces
from middleware.entangled.network.multicast import GROUP, GROUP6
from middleware.entangled.network.network import MAX_DATAGRAM_BYTES, Address, Receiver

LIST_INTERVAL_S = 3.0
"""The seconds between two listings of the interfaces; a listing takes 0.1 ms."""
_IP_PKTINFO, _IP_MULTICAST_ALL, _IPV6_MULTICAST_ALL = 8, 49, 29


class LanMulticast:
    """A ``Multicast`` for a node that listens at ``host`` (``""``, ``"*"`` or an unspecified address: every interface).

    ``counters`` counts datagrams: sent, received and unsent.
    """

    _log = Logger()

    def __init__(self, reactor: Any, host: str, look: Callable[[], list[Interface]] = list_interfaces) -> None:
        self._on_move: Callable[[], None] = lambda: None
        self.counters: Counter[str] = Counter()
        self._reactor = reactor
        self._host = host
        self._list_interfaces = look
        self._interfaces: list[Interface] = []
        self._families: list[_Family] = []
        self._timer: IDelayedCall | None = None

    def listen(self, receiver: Receiver, on_moved: Callable[[], None]) -> None:
        """Join the group on every interface and pass datagrams to ``receiver``; skip unavailable address families."""
        self._on_move = on_moved
        for kind in (_Ipv4, _Ipv6):
            try:
                self._families.append(kind(self._reactor, receiver, self.counters))
            except OSError as error:
                self._log.debug(
                    "multicast is not available for {family}: {why}", family=kind.__name__, why=error.strerror or error
                )
        self._update_interfaces()

    def send(self, datagram: bytes) -> None:
        """Send to the group from every address of every interface."""
        for interface in self._interfaces:
            for family in self._families:
                family.send(datagram, interface)

    def close(self) -> None:
        """Leave the group; may be called twice."""
        cancel(self._timer)
        families, self._families = self._families, []
        for family in families:
            family.close()

    def _update_interfaces(self) -> None:
        cancel(self._timer)
        self._timer = self._reactor.callLater(LIST_INTERVAL_S, self._update_interfaces)
        found = select_interfaces(self._list_interfaces(), self._host)
        if found == self._interfaces:
            return
        is_first, self._interfaces = not self._interfaces, found
        for interface in found:
            for family in self._families:
                family.join(interface)
        shown = ", ".join(f"{each.name} {' '.join(each.addresses)}" for each in found) or "no interface"
        self._log.info("searching for the team on the LAN, interfaces: {interfaces}", interfaces=shown)
        if not is_first:
            self._on_move()


class _Family:
    """The two ports of one address family."""

    family: socket.AddressFamily
    group: Address
    bound: Address

    def __init__(self, reactor: Any, receiver: Receiver, counters: Counter[str]) -> None:
        self._counters = counters
        self._receiving_port = self._sending_port = None
        protocol = _Protocol(receiver, counters)
        self._receiving_port = self._open_port(reactor, protocol, self.bound)
        try:
            self._sending_port = self._open_port(reactor, _Protocol(receiver, counters), Address("", 0))
        except OSError:
            self.close()
            raise

    def join(self, interface: Interface) -> None:
        """Join the group on ``interface``."""
        if self._receiving_port is not None:
            # This fails if the interface has already joined the group, or has no address of this family.
            with suppress(OSError):
                self._join(self._receiving_port.socket, interface.index)

    def send(self, datagram: bytes, interface: Interface) -> None:
        """Send to the group on ``interface``, from each of its addresses of this family."""
        for address in interface.addresses:
            if (":" in address) == (self.family == socket.AF_INET6) and self._sending_port is not None:
                try:
                    self._sending_port.socket.sendmsg(
                        [datagram], [self._source_option(interface.index, address)], 0, self.group
                    )
                except OSError:
                    self._counters["unsent"] += 1
                else:
                    self._counters["sent"] += 1

    def close(self) -> None:
        """Close both ports."""
        for port in (self._receiving_port, self._sending_port):
            if port is not None:
                port.stopListening()
        self._receiving_port = self._sending_port = None

    def _open_port(self, reactor: Any, protocol: DatagramProtocol, at: Address) -> Any:
        with socket.socket(self.family, socket.SOCK_DGRAM) as sock:
            sock.setblocking(False)
            if at.port:
                # Every node of this machine receives the datagrams of the group.
                sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            self._prepare(sock)
            sock.bind(at)
            return reactor.adoptDatagramPort(sock.fileno(), self.family, protocol, MAX_DATAGRAM_BYTES + 1)

    def _prepare(self, sock: socket.socket) -> None:
        raise NotImplementedError

    def _join(self, ear: socket.socket, index: int) -> None:
        raise NotImplementedError

    def _source_option(self, index: int, address: str) -> tuple[int, int, bytes]:
        raise NotImplementedError


class _Ipv4(_Family):
    family = socket.AF_INET
    group = GROUP
    bound = GROUP

    def _prepare(self, sock: socket.socket) -> None:
        sock.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 1)
        sock.setsockopt(socket.IPPROTO_IP, _IP_MULTICAST_ALL, 0)

    def _join(self, ear: socket.socket, index: int) -> None:
        request = struct.pack("4s4si", socket.inet_aton(self.group.host), bytes(4), index)
        ear.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, request)

    def _source_option(self, index: int, address: str) -> tuple[int, int, bytes]:
        return socket.IPPROTO_IP, _IP_PKTINFO, struct.pack("i4s4s", index, socket.inet_aton(address), bytes(4))


class _Ipv6(_Family):
    family = socket.AF_INET6
    group = GROUP6
    bound = Address("::", GROUP6.port)

    def _prepare(self, sock: socket.socket) -> None:
        sock.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 1)
        sock.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_MULTICAST_HOPS, 1)
        sock.setsockopt(socket.IPPROTO_IPV6, _IPV6_MULTICAST_ALL, 0)

    def _join(self, ear: socket.socket, index: int) -> None:
        request = struct.pack("16si", socket.inet_pton(socket.AF_INET6, self.group.host), index)
        ear.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_JOIN_GROUP, request)

    def _source_option(self, index: int, address: str) -> tuple[int, int, bytes]:
        packed = socket.inet_pton(socket.AF_INET6, address)
        return socket.IPPROTO_IPV6, socket.IPV6_PKTINFO, struct.pack("16si", packed, index)


class _Protocol(DatagramProtocol):
    def __init__(self, receiver: Receiver, counters: Counter[str]) -> None:
        self._receiver = receiver
        self._counters = counters

    def datagramReceived(self, datagram: bytes, addr: Any) -> None:
        """Pass a datagram to the receiver."""
        if len(datagram) <= MAX_DATAGRAM_BYTES:
            self._counters["received"] += 1
            self._receiver(datagram, Address(addr[0], addr[1]))

    def connectionRefused(self) -> None:
        """Ignore the ICMP message, because it may be forged."""
