"""Simulate the byte streams between many nodes in one process, in place of ``tcp``.

A stream delivers bytes in order, after ``delay_s`` seconds, at most ``rate`` bytes per second.  Further bytes wait in
the stream's buffer, and a producer is paused while the buffer is full.  If a path is cut, neither end notices this: the
bytes wait, as in TCP.  A single stream can also be stalled (``Pipe.is_stalled``); its bytes wait, and it retransmits
without success.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from twisted.internet.error import ConnectionAborted, ConnectionDone
from twisted.internet.interfaces import IAddress, IDelayedCall, IProtocol, IReactorTime
from twisted.python.failure import Failure
from zope.interface import implementer

from middleware.entangled.background import cancel
from middleware.entangled.errors import PortInUse
from middleware.entangled.network.network import Address
from middleware.entangled.network.stream_transport import Accept, StreamState

CHUNK_BYTES = 4096
RETRANSMIT_S = 0.2
"""The seconds between two retransmissions."""


class PipeNetwork:
    """Connects the transports of one process."""

    def __init__(self, clock: IReactorTime, delay_s: float = 0.0, rate: float = float("inf")) -> None:
        self.delay_s = delay_s
        self.rate = rate
        self.dialled: list[tuple[str, Address]] = []
        """The dialling host and the destination of each connection since the start."""
        self.streams: list[Pipe] = []
        """The dialling ends of the open connections."""
        self.clock = clock
        self._listeners: dict[Address, Accept] = {}
        self._cut: set[str] = set()

    def make_transport(self, host: str, port: int = 0) -> PipeTransport:
        """Return a transport of the host ``host``, which listens at ``port``."""
        return PipeTransport(self, Address(host, port))

    def cut(self, host: str) -> None:
        """Block all bytes from and to ``host``; its streams stay open and stall."""
        self._cut.add(host)

    def heal(self) -> None:
        """Undo every cut; the buffered bytes arrive."""
        self._cut.clear()
        for pipe in self.streams:
            for end in (pipe, pipe.other):
                end.pump()

    def _is_connected(self, *hosts: str) -> bool:
        return self._cut.isdisjoint(hosts)

    def _connect(self, host: str, to: Address, protocol: IProtocol, failed: Callable[[str], None]) -> None:
        accept = self._listeners.get(to)
        if not self._is_connected(host, to.host):
            self.clock.callLater(5.0, failed, "timed out")
            return
        theirs = None if accept is None else accept(host)
        if accept is None:
            failed("refused")
            return
        near, far = Pipe(self, host), Pipe(self, to.host)
        ends: tuple[Any, Any] = near, far
        near.other, far.other = far, near
        self.streams.append(near)
        near.protocol, far.protocol = protocol, theirs
        if theirs is not None:
            theirs.makeConnection(ends[1])
        protocol.makeConnection(ends[0])
        if theirs is None:
            far.abortConnection()


class PipeTransport:
    """The ``StreamTransport`` of one host."""

    def __init__(self, pipes: PipeNetwork, address: Address) -> None:
        self._pipes = pipes
        self._address = address

    def listen(self, accept: Accept) -> None:
        """Accept connections; raises ``PortInUse``."""
        if self._address in self._pipes._listeners:
            raise PortInUse(f"{self._address}: the port is in use; choose another port")
        self._pipes._listeners[self._address] = accept

    def dial(self, to: Address, protocol: IProtocol, failed: Callable[[str], None]) -> None:
        """Connect ``protocol`` to the listener at ``to``."""
        self._pipes.dialled.append((self._address.host, to))
        # The duration of the TCP handshake.
        self._pipes.clock.callLater(
            2 * self._pipes.delay_s, self._pipes._connect, self._address.host, to, protocol, failed
        )

    def read_state(self, transport: Any) -> StreamState | None:
        """Return the state of the stream of a transport."""
        return (
            StreamState(transport.unacked, transport.acknowledged, transport.retransmissions)
            if isinstance(transport, Pipe)
            else None
        )

    def close(self) -> None:
        """Stop listening."""
        self._pipes._listeners.pop(self._address, None)


@implementer(IAddress)
class _Host:
    def __init__(self, host: str) -> None:
        self.host = host


class Pipe:
    """One end of a stream, with the interface of a Twisted transport.

    If ``is_reading`` is False, the application reads nothing more from this end.  If ``is_stalled`` is True, everything
    that this end sends is lost.  ``acknowledged`` is the number of bytes that the other end has acknowledged.
    """

    bufferSize = 65536  # noqa: N815

    def __init__(self, pipes: PipeNetwork, host: str) -> None:
        self.other: Pipe
        self.protocol: IProtocol | None = None
        self.host = host
        self.is_reading = True
        self.is_lost = False
        self.buffer = bytearray()
        self.acknowledged = 0
        self._written = 0
        self._is_stalled = False
        self._stalled_since = 0.0
        self._pipes = pipes
        self._producer: Any = None
        self._is_paused = False
        self._is_closing = False
        self._timer: IDelayedCall | None = None

    @property
    def is_stalled(self) -> bool:
        """Whether everything that this end sends is lost."""
        return self._is_stalled

    @is_stalled.setter
    def is_stalled(self, is_so: bool) -> None:
        self._is_stalled, self._stalled_since = is_so, self._pipes.clock.seconds()
        self.pump()

    @property
    def unacked(self) -> int:
        """The number of bytes that are not acknowledged."""
        return self._written - self.acknowledged

    @property
    def retransmissions(self) -> int:
        """The number of retransmissions since the stream stalled."""
        is_vain = self._is_stalled and self.unacked
        return int((self._pipes.clock.seconds() - self._stalled_since) / RETRANSMIT_S) if is_vain else 0

    def write(self, data: bytes) -> None:
        """Send bytes."""
        if self.is_lost or self._is_closing:
            return
        self.buffer += data
        self._written += len(data)
        if self._producer is not None and not self._is_paused and len(self.buffer) > self.bufferSize:
            self._is_paused = True
            self._producer.pauseProducing()
        self.pump()

    def registerProducer(self, producer: Any, streaming: bool) -> None:  # noqa: N802
        """Pause ``producer`` while the buffer is full."""
        self._producer = producer

    def unregisterProducer(self) -> None:  # noqa: N802
        """Remove the producer."""
        self._producer = None

    def loseConnection(self) -> None:  # noqa: N802
        """Close the stream after sending the buffer."""
        self._is_closing = True
        self.pump()

    def abortConnection(self) -> None:  # noqa: N802
        """Close the stream immediately; the other end is notified unless the path is cut."""
        if not self.is_lost:
            if self._pipes._is_connected(self.host, self.other.host):
                self._pipes.clock.callLater(self._pipes.delay_s, self.other._close, ConnectionAborted())
            self._close(ConnectionAborted())

    def getPeer(self) -> IAddress:  # noqa: N802
        """Return the address of the other end."""
        return _Host(self.other.host)

    def pump(self) -> None:
        """Send the next bytes of the buffer, if possible."""
        if self._timer is not None or self.is_lost:
            return
        if self._is_stalled or not self._pipes._is_connected(self.host, self.other.host) or not self.other.is_reading:
            return
        if self.buffer:
            piece = bytes(self.buffer[:CHUNK_BYTES])
            del self.buffer[:CHUNK_BYTES]
            self._timer = self._pipes.clock.callLater(len(piece) / self._pipes.rate, self._on_sent, piece)
        elif self._is_closing:
            self._pipes.clock.callLater(self._pipes.delay_s, self.other._close, ConnectionDone())
            self._close(ConnectionDone())

    def _on_sent(self, piece: bytes) -> None:
        self._timer = None
        self._pipes.clock.callLater(self._pipes.delay_s, self.other._deliver, piece)
        self._pipes.clock.callLater(2 * self._pipes.delay_s, self._acknowledge, len(piece))
        if not self.buffer and self._is_paused and self._producer is not None:
            self._is_paused = False
            self._producer.resumeProducing()
        self.pump()

    def _acknowledge(self, size: int) -> None:
        self.acknowledged += size

    def _deliver(self, piece: bytes) -> None:
        if not self.is_lost and self.protocol is not None:
            self.protocol.dataReceived(piece)

    def _close(self, error: Exception) -> None:
        if self.is_lost:
            return
        self.is_lost = True
        self.buffer.clear()
        cancel(self._timer)
        if self in self._pipes.streams:
            self._pipes.streams.remove(self)
        if self.protocol is not None:
            self.protocol.connectionLost(Failure(error))
