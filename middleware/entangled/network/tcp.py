"""Open the byte streams of tunnels over TCP."""

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
from middleware.entangled.network.network import ANY_HOST, Address
from middleware.entangled.network.stream_transport import Accept, StreamState

CONNECT_S = 3.0
_NOTSENT_LOWAT = 25
_THIN_LINEAR_TIMEOUTS = 16
"""The socket option that retransmits a stream with little data in flight, such as a tunnel, six times without
exponential backoff (Linux, tcp(7)).  With backoff, a stream would stall for seconds at 30 % loss."""
_RTO_MAX_MS = 44
MAX_RETRANSMIT_MS = 1000
"""The maximum retransmission timeout in milliseconds (Linux 6.15 and later)."""
_INFO_BYTES = 148
MAX_UNSENT_BYTES = 16 * 1024
"""The bytes of a stream that the system may buffer (Linux).  The limit is low, because buffered bytes cannot be dropped
and arrive late."""


class TcpTransport:
    """Byte streams over TCP; listens at ``port`` of ``host``, a numeric address or ``*`` (all of IPv4 and IPv6)."""

    def __init__(self, reactor: Any, host: str = ANY_HOST, port: int = 0) -> None:
        self._reactor = reactor
        self._host = host
        self._requested_port = port
        self._port: IListeningPort | None = None
        self._connectors: set[Deferred[Any]] = set()
        self.closed: Deferred[Any] | None = None

    @property
    def port(self) -> int:
        """The port at which the transport listens."""
        return self._requested_port if self._port is None else int(self._port.getHost().port)  # type: ignore[attr-defined]

    def listen(self, accept: Accept) -> None:
        """Accept connections; raises ``PortInUse``."""
        try:
            port = self._listen_on_families(accept)
        except CannotListenError as error:
            reason = getattr(error.socketError, "strerror", None) or error.socketError
            remedy = "choose another port"
            if getattr(error.socketError, "errno", None) == errno.EACCES:
                remedy = "permit it (AmbientCapabilities=CAP_NET_BIND_SERVICE), or use a port above 1023 behind a proxy"
            raise TunnelPortInUse(f"TCP {self._host}:{self._requested_port}: {reason}; {remedy}") from error
        # Accepted connections inherit the options.
        _configure(port.socket)
        self._port = port

    def dial(self, to: Address, protocol: IProtocol, failed: Callable[[str], None]) -> None:
        """Resolve the name in ``to``, and connect ``protocol`` to the listener there."""
        # Imported at the first call, because most nodes never dial.
        from twisted.internet.endpoints import HostnameEndpoint

        attempt = HostnameEndpoint(self._reactor, to.host, to.port, timeout=CONNECT_S).connect(_SingleFactory(protocol))
        self._connectors.add(attempt)

        def on_connected(_: object) -> None:
            self._connectors.discard(attempt)
            transport: Any = getattr(protocol, "transport", None)
            if transport is not None and hasattr(transport, "getHandle"):
                _configure(transport.getHandle())

        def on_failed(failure: Failure) -> None:
            self._connectors.discard(attempt)
            if failure.check(CancelledError) is None:
                failed(failure.getErrorMessage())

        attempt.addCallbacks(on_connected, on_failed)

    def read_state(self, transport: Any) -> StreamState | None:
        """Return the state of a transport's stream from ``struct tcp_info``; None on systems other than Linux."""
        if sys.platform != "linux" or not hasattr(transport, "getHandle"):
            return None
        try:
            info = transport.getHandle().getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, _INFO_BYTES)
        except OSError:
            return None  # the connection has just been lost
        if len(info) < _INFO_BYTES:
            return None  # Linux before 4.6
        segment, unacked = struct.unpack_from("=I4xI", info, 16)
        (repeated,) = struct.unpack_from("=I", info, 100)
        acked, unsent = struct.unpack_from("=Q16xI", info, 120)
        return StreamState(unacked * segment + unsent, acked, repeated)

    def close(self) -> None:
        """Stop listening and dialling."""
        for attempt in list(self._connectors):
            attempt.cancel()
        if self._port is not None:
            port, self._port = self._port, None
            self.closed = port.stopListening()

    def _listen_on_families(self, accept: Accept) -> Any:
        if self._host == ANY_HOST:
            # One port for both address families, if the machine has both.
            with suppress(CannotListenError):
                return self._reactor.listenTCP(self._requested_port, _AcceptFactory(accept), 128, "::")
        return self._reactor.listenTCP(
            self._requested_port, _AcceptFactory(accept), 128, "" if self._host == ANY_HOST else self._host
        )


class _AcceptFactory(Factory):
    noisy = False

    def __init__(self, accept: Accept) -> None:
        self._accept = accept

    def buildProtocol(self, addr: Any) -> Any:
        """Return the protocol for the connecting host, or None to close the connection."""
        return self._accept(str(addr.host))


class _SingleFactory(Factory):
    noisy = False

    def __init__(self, protocol: IProtocol) -> None:
        self._protocol = protocol

    def buildProtocol(self, addr: Any) -> Any:
        """Return the protocol that waits for its connection."""
        return self._protocol


def _configure(stream: Any) -> None:
    """Limit the send buffer of a stream, disable the delay of small segments, and shorten retransmissions."""
    options = [(socket.TCP_NODELAY, 1)]
    if sys.platform == "linux":
        options += [(_NOTSENT_LOWAT, MAX_UNSENT_BYTES), (_THIN_LINEAR_TIMEOUTS, 1), (_RTO_MAX_MS, MAX_RETRANSMIT_MS)]
    for option, value in options:
        with suppress(OSError):  # the connection has just been lost, or the system does not have the option
            stream.setsockopt(socket.IPPROTO_TCP, option, value)
