"""Carry datagrams over one WebSocket connection of a tunnel, with bounded queues.

A stream delivers everything in order, however late, but a late heartbeat is worse than a lost heartbeat.  Therefore
queues are short: a new datagram that does not fit is dropped, and short datagrams are sent before long datagrams.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import Any, Protocol

from twisted.internet.interfaces import IDelayedCall, IPushProducer, IReactorTime
from twisted.internet.protocol import Protocol as StreamProtocol
from twisted.python.failure import Failure
from zope.interface import implementer

from formats.websocket import CLOSE_NORMAL
from middleware.entangled.background import cancel
from middleware.entangled.network.layer import StreamLayer
from middleware.entangled.network.network import Address
from middleware.entangled.network.websocket import WebSocket

SHORT_BYTES = 300
"""The length limit of short datagrams: heartbeats, receipts, discovery and most requests; full fragments have 1400
bytes."""
MAX_QUEUED_BYTES, MAX_LONG_QUEUED_BYTES = 40 * 1024, 32 * 1024
"""A short datagram is accepted up to the first number of bytes in the queues, a long datagram up to the second
number."""
MAX_SEND_BUFFER_BYTES = 16 * 1024
"""The bytes that may wait in the transport, where short datagrams cannot overtake long ones.  Queues and transport
together buffer less than 64 KiB."""
QUIET_S, IDLE_S = 5.0, 20.0
"""The silence in seconds after which a connection is pinged: if datagrams are sent on it, and if none are sent."""
PONG_S = 5.0
"""The time in seconds without a pong after which the peer is considered unreachable although the connection is open."""
STALL_S = 30.0
"""The time in seconds without progress in sending after which the connection is closed."""
CLOSE_S = 2.0
"""The time in seconds for the closing handshake."""


class ConnectionListener(Protocol):
    """Receives the events of tunnel connections."""

    def on_connection_open(self, connection: TunnelConnection) -> bool:
        """Called when datagrams can be sent; if it returns False, the connection is closed."""

    def on_connection_datagram(self, connection: TunnelConnection, datagram: bytes) -> None:
        """Process a datagram."""

    def on_connection_closed(self, connection: TunnelConnection, why: str) -> None:
        """Called once when the connection is closed."""


@implementer(IPushProducer)
class TunnelConnection(StreamProtocol):
    """One connection; ``address`` is the virtual address of its peer, ``host`` the source of its stream.

    ``layers`` are the layers around the WebSocket, the outermost first.  ``dropped`` counts the datagrams that did not
    fit into the queues.
    """

    def __init__(
        self,
        listener: ConnectionListener,
        clock: IReactorTime,
        address: Address,
        host: str,
        layers: Sequence[StreamLayer],
        socket: WebSocket,
    ) -> None:
        self.address = address
        self.host = host
        self.started_at = self.last_received_at = clock.seconds()
        self.is_closed = False
        self.dropped = 0
        self.socket = socket
        self._listener = listener
        self._clock = clock
        self._layers = layers
        self._short: deque[bytes] = deque()
        self._long: deque[bytes] = deque()
        self._queued_bytes = 0
        self._pinged_at: float | None = None
        self._paused_at: float | None = None
        self._close_timer: IDelayedCall | None = None

    @property
    def is_open(self) -> bool:
        """Whether datagrams can be sent."""
        return self.socket.is_open and not self.is_closed

    @property
    def is_closing(self) -> bool:
        """Whether the closing handshake is under way."""
        return self._close_timer is not None and self._close_timer.active()

    @property
    def queued_bytes(self) -> int:
        """The number of queued bytes."""
        return self._queued_bytes

    def send(self, datagram: bytes) -> None:
        """Send a datagram, queue it, or drop it."""
        now = self._clock.seconds()
        if self.is_open and self._paused_at is None:
            self._write_framed(datagram)
            if now - self.last_received_at > QUIET_S:
                self._ping(now)
            return
        is_short = len(datagram) <= SHORT_BYTES
        if self.is_closed or self._queued_bytes + len(datagram) > (
            MAX_QUEUED_BYTES if is_short else MAX_LONG_QUEUED_BYTES
        ):
            self.dropped += 1
            return
        (self._short if is_short else self._long).append(datagram)
        self._queued_bytes += len(datagram)

    def check(self, now: float) -> None:
        """Check whether the other end still answers and accepts data; called about once per second."""
        if not self.is_open:
            return
        if self._pinged_at is not None and now - self._pinged_at > PONG_S:
            self.close("no answer to a ping", is_rude=True)
        elif self._paused_at is not None and now - self._paused_at > STALL_S:
            self.close("the other end accepts no data", is_rude=True)
        elif now - self.last_received_at > IDLE_S:
            self._ping(now)

    def close(self, why: str, code: int = CLOSE_NORMAL, is_rude: bool = False) -> None:
        """Close the connection: with a closing handshake, or immediately if ``is_rude``."""
        if self.is_closed:
            return
        transport: Any = self.transport
        if self.is_open and not is_rude and self._paused_at is None:
            self._write(self._layers, self.socket.encode_close(code))
        self._finish(why)
        if transport is None:
            return
        transport.unregisterProducer()
        if is_rude or self._paused_at is not None:
            transport.abortConnection()
        else:
            self._close_timer = self._clock.callLater(CLOSE_S, transport.abortConnection)
            transport.loseConnection()

    def cancel_close(self) -> None:
        """Cancel the timer of the closing handshake."""
        cancel(self._close_timer)

    # -- called by the stream ---------------------------------------------------------------------------------------

    def connectionMade(self) -> None:
        """Open the outermost layer."""
        transport: Any = self.transport
        if self.is_closed:
            transport.abortConnection()
            return
        transport.bufferSize = MAX_SEND_BUFFER_BYTES
        transport.registerProducer(self, True)
        self._send_opening(0)

    def dataReceived(self, data: bytes) -> None:
        """Pass bytes through all layers."""
        if self.is_closed:
            return
        self.last_received_at = self._clock.seconds()
        self._pinged_at = None
        for number, layer in enumerate(self._layers):
            was_open = layer.is_open
            data, reply = layer.decode(data)
            if reply:
                self._write(self._layers[:number], reply)
            if layer.fault:
                self.close(layer.fault)
                return
            if not layer.is_open:
                return
            if not was_open:
                self._send_opening(number + 1)
        if data:
            self._process(data)

    def connectionLost(self, reason: Failure | None = None) -> None:
        """Report that the connection was closed."""
        cancel(self._close_timer)
        self._finish(
            "the connection was lost"
            if self.socket.is_open
            else "the other end closed the connection before a tunnel was open"
        )

    def pauseProducing(self) -> None:
        """Queue datagrams from now on, because the buffer of the transport is full."""
        if self._paused_at is None:
            self._paused_at = self._clock.seconds()

    def resumeProducing(self) -> None:
        """Send queued datagrams, because the transport accepts more."""
        self._paused_at = None
        while self.is_open and self._paused_at is None and (self._short or self._long):
            datagram = (self._short or self._long).popleft()
            self._queued_bytes -= len(datagram)
            self._write_framed(datagram)

    def stopProducing(self) -> None:
        """Do nothing; ``connectionLost`` follows."""

    # -- private ----------------------------------------------------------------------------------------------------

    def _send_opening(self, number: int) -> None:
        """Send the first bytes of a layer, or of the WebSocket inside all layers."""
        part = self._layers[number] if number < len(self._layers) else self.socket
        opening = part.opening()
        if opening:
            self._write(self._layers[:number], opening)

    def _process(self, data: bytes) -> None:
        was_open = self.socket.is_open
        datagrams, reply = self.socket.receive_data(data)
        if reply:
            self._write(self._layers, reply)
        if self.socket.is_open and not was_open:
            if not self._listener.on_connection_open(self):
                self.close("too many connections")
                return
            self.resumeProducing()
        for datagram in datagrams:
            if self.is_closed:
                return
            self._listener.on_connection_datagram(self, datagram)
        if self.socket.fault:
            self.close(self.socket.fault)

    def _ping(self, now: float) -> None:
        if self._pinged_at is None:
            self._pinged_at = now
            self._write(self._layers, self.socket.encode_ping())

    def _write_framed(self, datagram: bytes) -> None:
        self._write(self._layers, self.socket.encode_binary(datagram))

    def _write(self, layers: Sequence[StreamLayer], data: bytes) -> None:
        for layer in reversed(layers):
            data = layer.encode(data)
        transport: Any = self.transport
        transport.write(data)

    def _finish(self, why: str) -> None:
        if not self.is_closed:
            self.is_closed = True
            self._short.clear()
            self._long.clear()
            self._queued_bytes = 0
            self._listener.on_connection_closed(self, why)
