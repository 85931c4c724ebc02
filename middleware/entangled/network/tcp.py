"""Tcp: the byte streams of tunnels over real TCP."""

from __future__ import annotations

import errno
import socket
import struct
import sys
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from twisted.internet.defer import CancelledError, Deferred
from twisted.internet.error import CannotListenError
from twisted.internet.interfaces import IListeningPort, IProtocol
from twisted.internet.protocol import Factory
from twisted.python.failure import Failure

from middleware.entangled.errors import TunnelPortInUse
from middleware.entangled.network.carrier import Accept, Strain
from middleware.entangled.network.network import EVERYWHERE, Address

CONNECT_S = 3.0
_NOTSENT_LOWAT = 25
_THIN_LINEAR_TIMEOUTS = 16
"""Where little is on its way, as here, the first six repetitions do not come later and later (Linux, tcp(7)): with 30 %
loss a stream would stand still for seconds."""
_RTO_MAX_MS = 44
LONGEST_WAIT_MS = 1000
"""Milliseconds after which at the latest a lost piece is repeated again (Linux 6.15 and later)."""
_INFO_BYTES = 148
UNSENT = 16 * 1024
"""Bytes that the system may hold back of a stream (Linux): of what it holds nothing is dropped, and all is late."""


class TcpCarrier:
    """Streams over TCP; it listens at ``host`` (a numeric address; ``*``: all of IPv4 and IPv6) and ``port``."""

    def __init__(self, reactor: Any, host: str = EVERYWHERE, port: int = 0) -> None:
        self._reactor = reactor
        self._host = host
        self._wanted = port
        self._port: IListeningPort | None = None
        self._dialling: set[Deferred[Any]] = set()
        self.closed: Deferred[Any] | None = None

    @property
    def number(self) -> int:
        """The port at which it listens."""
        return self._wanted if self._port is None else int(self._port.getHost().port)  # type: ignore[attr-defined]

    def listen(self, accept: Accept) -> None:
        """Be there for those that dial; raises ``PortInUse``."""
        try:
            port = self._listening(accept)
        except CannotListenError as error:
            why = getattr(error.socketError, "strerror", None) or error.socketError
            remedy = "choose another port"
            if getattr(error.socketError, "errno", None) == errno.EACCES:
                remedy = "let it (AmbientCapabilities=CAP_NET_BIND_SERVICE), or take a port above 1023 behind a proxy"
            raise TunnelPortInUse(f"TCP {self._host}:{self._wanted}: {why}; {remedy}") from error
        # What is accepted there inherits it.
        _tuned(port.socket)
        self._port = port

    def dial(self, to: Address, protocol: IProtocol, failed: Callable[[str], None]) -> None:
        """Connect ``protocol`` with who listens at ``to``, whose names are looked up."""
        # Loaded by the first who dials: most nodes never do.
        from twisted.internet.endpoints import HostnameEndpoint

        begun = HostnameEndpoint(self._reactor, to.host, to.port, timeout=CONNECT_S).connect(_Once(protocol))
        self._dialling.add(begun)

        def made(_: object) -> None:
            self._dialling.discard(begun)
            transport: Any = getattr(protocol, "transport", None)
            if transport is not None and hasattr(transport, "getHandle"):
                _tuned(transport.getHandle())

        def lost(failure: Failure) -> None:
            self._dialling.discard(begun)
            if failure.check(CancelledError) is None:
                failed(failure.getErrorMessage())

        begun.addCallbacks(made, lost)

    def strain(self, transport: Any) -> Strain | None:
        """How the stream of a transport does, as Linux tells (``struct tcp_info``); None on other systems."""
        if sys.platform != "linux" or not hasattr(transport, "getHandle"):
            return None
        try:
            info = transport.getHandle().getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, _INFO_BYTES)
        except OSError:
            return None  # it was lost meanwhile
        if len(info) < _INFO_BYTES:
            return None  # before Linux 4.6
        segment, unacked = struct.unpack_from("=I4xI", info, 16)
        (repeated,) = struct.unpack_from("=I", info, 100)
        acked, unsent = struct.unpack_from("=Q16xI", info, 120)
        return Strain(unacked * segment + unsent, acked, repeated)

    def close(self) -> None:
        """Be there no more, and dial no more."""
        for begun in list(self._dialling):
            begun.cancel()
        if self._port is not None:
            port, self._port = self._port, None
            self.closed = port.stopListening()

    def _listening(self, accept: Accept) -> Any:
        if self._host == EVERYWHERE:
            # One port for both families, where the machine has both.
            with suppress(CannotListenError):
                return self._reactor.listenTCP(self._wanted, _Door(accept), 128, "::")
        return self._reactor.listenTCP(self._wanted, _Door(accept), 128, "" if self._host == EVERYWHERE else self._host)


class _Door(Factory):
    noisy = False

    def __init__(self, accept: Accept) -> None:
        self._accept = accept

    def buildProtocol(self, addr: Any) -> Any:
        """The protocol for who comes from there, or None, and the connection is closed."""
        return self._accept(str(addr.host))


class _Once(Factory):
    noisy = False

    def __init__(self, protocol: IProtocol) -> None:
        self._protocol = protocol

    def buildProtocol(self, addr: Any) -> Any:
        """The protocol that waits for its connection."""
        return self._protocol


def _tuned(stream: Any) -> None:
    """Have the system hold back little of a stream, send it at once, and send what was lost again soon."""
    options = [(socket.TCP_NODELAY, 1)]
    if sys.platform == "linux":
        options += [(_NOTSENT_LOWAT, UNSENT), (_THIN_LINEAR_TIMEOUTS, 1), (_RTO_MAX_MS, LONGEST_WAIT_MS)]
    for option, value in options:
        with suppress(OSError):  # it was lost meanwhile, or the system has no such option
            stream.setsockopt(socket.IPPROTO_TCP, option, value)
