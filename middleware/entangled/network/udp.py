"""Udp: a ``Network`` over one real UDP port of Twisted."""

from __future__ import annotations

import errno
import socket
from collections import Counter
from functools import lru_cache
from typing import Any

from twisted.internet.abstract import isIPAddress, isIPv6Address
from twisted.internet.defer import Deferred, succeed
from twisted.internet.error import CannotListenError
from twisted.internet.interfaces import IReactorUDP
from twisted.internet.protocol import DatagramProtocol
from twisted.logger import Logger

from middleware.entangled.errors import PortInUse
from middleware.entangled.network.network import MAX_DATAGRAM, Address, Receiver

# Bursts come in faster than Python reads: the usual 208 KiB hold 160 full datagrams, this holds five times as many.
RECEIVE_BUFFER = 1 << 20


class UdpNetwork:
    """One UDP port at ``host`` (an IP address; "0.0.0.0" or "::" for every interface) and ``port`` (0: any free one).

    ``counters`` counts the datagrams that were sent, received, unsent (no route, no such address, full buffer) and
    oversized.  ``closed`` fires when the port is really free again.
    """

    _log = Logger()

    def __init__(self, reactor: IReactorUDP, host: str, port: int = 0) -> None:
        self.counters: Counter[str] = Counter()
        self.closed: Deferred[Any] = succeed(None)
        self._reactor = reactor
        self._host = host
        self._wanted = port
        self._port: Any = None
        self._number = port

    @property
    def address(self) -> Address:
        """The node's own address; the port is known once ``listen`` was called."""
        return Address(self._host, self._number)

    def listen(self, receiver: Receiver) -> None:
        """Open the port and hand each datagram to ``receiver``; raises ``PortInUse`` where that cannot be."""
        if self._port is not None:
            return
        protocol = _Protocol(receiver, self.counters)
        try:
            # One byte more than may come, so that what is too large is seen to be.
            self._port = self._reactor.listenUDP(self._wanted, protocol, self._host, MAX_DATAGRAM + 1)
        except CannotListenError as error:
            why = getattr(error.socketError, "strerror", None) or error.socketError
            is_foreign = getattr(error.socketError, "errno", None) == errno.EADDRNOTAVAIL
            remedy = "give host an address of this machine" if is_foreign else "choose another port, or 0 for any"
            raise PortInUse(f"UDP {self._host}:{self._wanted}: {why}; {remedy}") from error
        self._number = self._port.getHost().port
        try:
            self._port.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER)
        except OSError as error:
            self._log.debug("the receive buffer stays as it is: {error}", error=error)

    def send(self, datagram: bytes, to: Address) -> None:
        """Send at most ``MAX_DATAGRAM`` bytes; what cannot be sent is counted and lost."""
        if len(datagram) > MAX_DATAGRAM:
            self.counters["oversized"] += 1
            return
        # The address comes from a peer: the system would look up what is no IP, and wait for the answer.
        if self._port is None or not _is_ip(to.host):
            self.counters["unsent"] += 1
            return
        try:
            # Past the port's own ``write``, which checks the address anew each time: half of what a send costs.
            self._port.socket.sendto(datagram, to)
        # Another family, ports out of range and a full buffer each raise something else.
        except (OSError, ValueError, OverflowError, TypeError):
            self.counters["unsent"] += 1
        else:
            self.counters["sent"] += 1

    def close(self) -> None:
        """Close the port; may be called twice."""
        if self._port is not None:
            port, self._port = self._port, None
            stopped = port.stopListening()
            self.closed = stopped if stopped is not None else succeed(None)


@lru_cache(maxsize=1024)
def _is_ip(host: str) -> bool:
    return bool(isIPAddress(host) or isIPv6Address(host))


class _Protocol(DatagramProtocol):
    def __init__(self, receiver: Receiver, counters: Counter[str]) -> None:
        self._receiver = receiver
        self._counters = counters

    def datagramReceived(self, datagram: bytes, addr: Any) -> None:
        """Hand a datagram on."""
        if len(datagram) > MAX_DATAGRAM:
            self._counters["oversized"] += 1
            return
        self._counters["received"] += 1
        self._receiver(datagram, Address(addr[0], addr[1]))

    def connectionRefused(self) -> None:
        """Ignore the ICMP message: anybody may forge one, and time-outs tell the same."""
