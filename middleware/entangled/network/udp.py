"""Implement ``Network`` over UDP with Twisted."""

from __future__ import annotations

import errno
import math
import socket
from collections import Counter
from collections.abc import Callable
from functools import lru_cache
from typing import Any

from twisted.internet.abstract import isIPAddress, isIPv6Address
from twisted.internet.defer import Deferred, gatherResults, maybeDeferred, succeed
from twisted.internet.error import CannotListenError
from twisted.internet.protocol import DatagramProtocol
from twisted.logger import Logger

from middleware.entangled.bounded import put_bounded
from middleware.entangled.errors import PortInUse
from middleware.entangled.network.interface import is_any, list_interfaces
from middleware.entangled.network.network import ANY_HOST, MAX_ASSIGNED, MAX_RELAYED_BYTES, Address, Receiver

# Bursts arrive faster than Python reads.  The usual buffer of 208 KiB has space for 160 full datagrams; this buffer has
# space for five times as many.
RECEIVE_BUFFER_BYTES = 1 << 20
ROUTE_CACHE_S = 5.0
"""The seconds for which routes and addresses are cached; they change, for example, when a laptop moves."""
_PORT_ATTEMPTS = 8


class UdpNetwork:
    """One UDP port at ``host`` and ``port`` (0: any free port), and additional ports that are opened later.

    ``host`` is an IP address ("0.0.0.0" or "::" for every interface of one address family), or ``ANY_HOST`` for every
    interface of both families; IPv6 is omitted on machines that do not support it.

    ``counters`` counts the datagrams that were sent, received, unsent (no route, invalid address, full buffer) and
    oversized.  ``closed`` fires when every port is closed.
    """

    _log = Logger()

    def __init__(self, reactor: Any, host: str, port: int = 0) -> None:
        self.counters: Counter[str] = Counter()
        self.closed: Deferred[Any] = succeed(None)
        self._reactor = reactor
        self._host = ANY_HOST if host == "" else host
        self._requested_port = port
        self._number = port
        self._receiver: Receiver | None = None
        self._ports: dict[tuple[int, bool], Any] = {}
        self._port_by_target: dict[Address, int] = {}
        self._routes: dict[str, tuple[str, float]] = {}
        self._hosts: list[str] = []
        self._hosts_at = -math.inf

    @property
    def address(self) -> Address:
        """The node's address; the port is known after ``listen``."""
        host = self._find_route("", self._own_host) if is_any(self._host) else self._host
        return Address(host, self._number)

    def listen(self, receiver: Receiver) -> None:
        """Open the port and pass each datagram to ``receiver``; raises ``PortInUse`` if that fails."""
        if self._ports:
            return
        self._receiver = receiver
        if self._host != ANY_HOST:
            self._number = self._open(0, self._host, self._requested_port)
            return
        for left in reversed(range(1 if self._requested_port else _PORT_ATTEMPTS)):
            self._number = self._open(0, "0.0.0.0", self._requested_port)
            try:
                self._open_ipv6(self._number)
                return
            except PortInUse:  # if no port is configured, any port is suitable that is free in both address families
                self._close_port(0)
                if not left:
                    raise

    def send(self, datagram: bytes, to: Address) -> None:
        """Send at most ``MAX_RELAYED_BYTES`` bytes; a datagram that cannot be sent is counted and lost."""
        if len(datagram) > MAX_RELAYED_BYTES:
            self.counters["oversized"] += 1
            return
        is_six = ":" in to.host
        number = self._port_by_target.get(to, 0) if self._port_by_target else 0
        port = self._ports.get((number, is_six)) or self._ports.get((0, is_six))
        # The address comes from a peer and may be a name, which the system would resolve and block until the answer.
        if port is None or not _is_ip(to.host):
            self.counters["unsent"] += 1
            return
        try:
            # Bypasses the port's ``write``, whose check of the address takes half of the time of a send.
            port.socket.sendto(datagram, to)
        # An invalid port number and a full buffer raise different types.
        except (OSError, ValueError, OverflowError, TypeError):
            self.counters["unsent"] += 1
        else:
            self.counters["sent"] += 1

    def close(self) -> None:
        """Close every port; may be called twice."""
        if self._ports:
            ports, self._ports = list(self._ports.values()), {}
            self._receiver = None
            self._port_by_target.clear()
            self.closed = gatherResults([maybeDeferred(port.stopListening) for port in ports])

    # -- additional ports -------------------------------------------------------------------------------------------

    def open_port(self) -> int:
        """Open an additional local port, with IPv4 if enabled, and return its number; 0 if that fails."""
        if not self._ports:
            return 0
        host = "0.0.0.0" if self._host == ANY_HOST else self._host
        try:
            return self._open(None, host, 0)
        except PortInUse:
            return 0

    def close_port(self, port: int) -> None:
        """Close an additional port."""
        if port:
            self._port_by_target = {to: number for to, number in self._port_by_target.items() if number != port}
            self._close_port(port)

    def assign_port(self, to: Address, port: int) -> int:
        """Assign ``port`` to the target ``to``; 0 is the listening port."""
        before = self._port_by_target.get(to, 0)
        put_bounded(self._port_by_target, to, port, MAX_ASSIGNED)
        return before

    def source_address(self, to: Address, port: int = 0) -> Address:
        """Return the local source address of datagrams to ``to``."""
        host = self._host
        if is_any(host):
            host = self._find_route(to.host, lambda: _ask_route(to.host)) or self.address.host
        return Address(host, port or self._port_by_target.get(to, 0) or self._number)

    def local_hosts(self) -> list[str]:
        """Return the addresses of this machine at which it listens, cached for ``ROUTE_CACHE_S``."""
        if not is_any(self._host):
            return [self._host]
        now = self._reactor.seconds()
        if now - self._hosts_at > ROUTE_CACHE_S:
            self._hosts, self._hosts_at = _list_own_hosts(), now
        families = {is_six for _, is_six in self._ports}
        return [host for host in self._hosts if (":" in host) in families]

    # -- private ----------------------------------------------------------------------------------------------------

    def _open(self, number: int | None, host: str, wanted: int) -> int:
        """Open a port, with the key ``number`` (None: its port number is the key); return its port number."""
        protocol = _Protocol(self, number or 0)
        try:
            # One byte more than the maximum, to detect oversized datagrams.
            port = self._reactor.listenUDP(wanted, protocol, host, MAX_RELAYED_BYTES + 1)
        except CannotListenError as error:
            raise _make_port_error(host, wanted, error.socketError) from error
        own: int = port.getHost().port
        protocol.number = own if number is None else number
        self._add_port(port, protocol.number, ":" in host)
        return own

    def _open_ipv6(self, wanted: int) -> None:
        """Open an IPv6 port in addition to the IPv4 port; Twisted alone would open a port that receives both."""
        try:
            with socket.socket(socket.AF_INET6, socket.SOCK_DGRAM) as sock:
                sock.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 1)
                sock.setblocking(False)
                sock.bind(("::", wanted))
                port = self._reactor.adoptDatagramPort(
                    sock.fileno(), socket.AF_INET6, _Protocol(self, 0), MAX_RELAYED_BYTES + 1
                )
        except OSError as error:
            if error.errno == errno.EADDRINUSE:
                raise _make_port_error("::", wanted, error) from error
            self._log.info("IPv6 is not available on this machine: {error}", error=error)
        else:
            self._add_port(port, 0, True)

    def _add_port(self, port: Any, number: int, is_six: bool) -> None:
        self._ports[number, is_six] = port
        try:
            port.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)
        except OSError as error:
            self._log.debug("cannot enlarge the receive buffer: {error}", error=error)

    def _close_port(self, number: int) -> None:
        for is_six in (False, True):
            port = self._ports.pop((number, is_six), None)
            if port is not None:
                maybeDeferred(port.stopListening)

    def _own_host(self) -> str:
        # Any address outside this machine is suitable, because nothing is sent; these are for documentation (RFC 5737,
        # 3849).
        six = self._host == "::"
        own = [host for host in _list_own_hosts() if (":" in host) == six]
        return _ask_route("2001:db8::1" if six else "192.0.2.1") or next(iter(own), "::1" if six else "127.0.0.1")

    def _find_route(self, host: str, ask: Callable[[], str]) -> str:
        """Return the route to ``host`` from the cache; if it is older than ``ROUTE_CACHE_S``, call ``ask`` again."""
        found, asked_at = self._routes.get(host, ("", -math.inf))
        now = self._reactor.seconds()
        if now - asked_at > ROUTE_CACHE_S:
            if len(self._routes) > MAX_ASSIGNED:
                self._routes.clear()
            found = ask()
            self._routes[host] = found, now
        return found

    def _receive(self, datagram: bytes, source: Address, number: int) -> None:
        if len(datagram) > MAX_RELAYED_BYTES:
            self.counters["oversized"] += 1
            return
        self.counters["received"] += 1
        if number and source not in self._port_by_target:
            self.assign_port(source, number)
        if self._receiver is not None:
            self._receiver(datagram, source)


def _make_port_error(host: str, port: int, error: Any) -> PortInUse:
    reason = getattr(error, "strerror", None) or error
    is_foreign = getattr(error, "errno", None) == errno.EADDRNOTAVAIL
    remedy = "set host to an address of this machine" if is_foreign else "choose another port, or 0 for any"
    return PortInUse(f"UDP {host}:{port}: {reason}; {remedy}")


def _list_own_hosts() -> list[str]:
    """Return the addresses of this machine that other nodes may reach, except loopback and link-local addresses."""
    found = [host for interface in list_interfaces() if not interface.is_loopback for host in interface.addresses]
    return sorted(found, key=lambda host: ":" in host)


def _ask_route(host: str) -> str:
    """Return the local source address for ``host``; empty if there is no route."""
    if not _is_ip(host):
        return ""
    try:
        with socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.connect((host, 9))  # sends nothing: it only looks up the route
            return str(probe.getsockname()[0])
    except OSError:
        return ""


@lru_cache(maxsize=1024)
def _is_ip(host: str) -> bool:
    return bool(isIPAddress(host) or isIPv6Address(host))


class _Protocol(DatagramProtocol):
    """Passes the datagrams of one port to its network, in which the port has the key ``number``."""

    def __init__(self, network: UdpNetwork, number: int) -> None:
        self._network = network
        self.number = number

    def datagramReceived(self, datagram: bytes, addr: Any) -> None:
        """Pass a datagram to the network."""
        self._network._receive(datagram, Address(addr[0], addr[1]), self.number)

    def connectionRefused(self) -> None:
        """Ignore the ICMP message, which may be forged; timeouts detect the same failure."""
