"""Carry datagrams over one WebSocket connection of a tunnel, with bounded queues.

A stream delivers everything in order, however late; a late heartbeat is worse than a lost one.  Therefore queues are
short: datagrams that do not fit are dropped, newest first, and short datagrams are sent before long ones.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import Any, Protocol

from twisted.internet.interfaces import IDelayedCall, IPushProducer, IReactorTime
from twisted.internet.protocol import Protocol as StreamProtocol
from twisted.python.failure import Failure
from zope.interface import implementer

from formats.websocket import NORMAL
from middleware.entangled.background import cancel
from middleware.entangled.network.layer import Layer
from middleware.entangled.network.network import Address
from middleware.entangled.network.websocket import WebSocket

SHORT = 300
"""The length limit of short datagrams: heartbeats, receipts, discovery and most requests; full fragments have 1400
bytes."""
MAX_WAITING, MAX_LONG = 40 * 1024, 32 * 1024
"""The bytes that may wait in the transport, which cannot reorder them; with the queues less than 64 KiB."""
MAX_SENDING = 16 * 1024
"""The bytes that may wait in the transport, where nothing overtakes them; with the queues less than 64 KiB."""
QUIET_S, IDLE_S = 5.0, 20.0
"""The silence in seconds after which a link is pinged, while datagrams are sent on it and otherwise."""
PONG_S = 5.0
"""The time in seconds without a pong after which the peer counts as gone although the connection is open."""
STALL_S = 30.0
"""The time in seconds without progress in sending after which the link is closed."""
CLOSE_S = 2.0
"""The time in seconds for the closing handshake."""


class Owner(Protocol):
    """Receives the events of its links."""

    def link_open(self, link: Link) -> bool:
        """Called when datagrams can be sent; returning False closes the link."""

    def link_said(self, link: Link, datagram: bytes) -> None:
        """Process a datagram."""

    def link_over(self, link: Link, why: str) -> None:
        """Called once when the link is closed."""


@implementer(IPushProducer)
class Link(StreamProtocol):
    """One connection; ``address`` is the virtual address of its peer, ``host`` the source of its stream.

    ``layers`` surround the WebSocket, the outermost first.  ``dropped`` counts the datagrams that did not fit.
    """

    def __init__(
        self,
        owner: Owner,
        clock: IReactorTime,
        address: Address,
        host: str,
        layers: Sequence[Layer],
        socket: WebSocket,
    ) -> None:
        self.address = address
        self.host = host
        self.begun_at = self.heard_at = clock.seconds()
        self.is_over = False
        self.dropped = 0
        self.socket = socket
        self._owner = owner
        self._clock = clock
        self._layers = layers
        self._short: deque[bytes] = deque()
        self._long: deque[bytes] = deque()
        self._waiting = 0
        self._pinged_at: float | None = None
        self._paused_at: float | None = None
        self._closing: IDelayedCall | None = None

    @property
    def is_open(self) -> bool:
        """Whether datagrams can be sent."""
        return self.socket.is_open and not self.is_over

    @property
    def is_closing(self) -> bool:
        """Whether the closing handshake is under way."""
        return self._closing is not None and self._closing.active()

    @property
    def waiting(self) -> int:
        """The number of queued bytes."""
        return self._waiting

    def send(self, datagram: bytes) -> None:
        """Send a datagram, queue it, or drop it."""
        now = self._clock.seconds()
        if self.is_open and self._paused_at is None:
            self._write_framed(datagram)
            if now - self.heard_at > QUIET_S:
                self._ping(now)
            return
        is_short = len(datagram) <= SHORT
        if self.is_over or self._waiting + len(datagram) > (MAX_WAITING if is_short else MAX_LONG):
            self.dropped += 1
            return
        (self._short if is_short else self._long).append(datagram)
        self._waiting += len(datagram)

    def look(self, now: float) -> None:
        """Check whether the other end is alive; called about once per second."""
        if not self.is_open:
            return
        if self._pinged_at is not None and now - self._pinged_at > PONG_S:
            self.end("no answer to a ping", is_rude=True)
        elif self._paused_at is not None and now - self._paused_at > STALL_S:
            self.end("the other end accepts no data", is_rude=True)
        elif now - self.heard_at > IDLE_S:
            self._ping(now)

    def end(self, why: str, code: int = NORMAL, is_rude: bool = False) -> None:
        """Close the connection: with a closing handshake, or immediately if ``is_rude``."""
        if self.is_over:
            return
        transport: Any = self.transport
        if self.is_open and not is_rude and self._paused_at is None:
            self._write(self._layers, self.socket.closing(code))
        self._finish(why)
        if transport is None:
            return
        transport.unregisterProducer()
        if is_rude or self._paused_at is not None:
            transport.abortConnection()
        else:
            self._closing = self._clock.callLater(CLOSE_S, transport.abortConnection)
            transport.loseConnection()

    def forget(self) -> None:
        """Cancel the timer of the closing handshake."""
        cancel(self._closing)

    # -- called by the stream ---------------------------------------------------------------------------------------

    def connectionMade(self) -> None:
        """Open the outermost layer."""
        transport: Any = self.transport
        if self.is_over:
            transport.abortConnection()
            return
        transport.bufferSize = MAX_SENDING
        transport.registerProducer(self, True)
        self._begin(0)

    def dataReceived(self, data: bytes) -> None:
        """Pass bytes through all layers."""
        if self.is_over:
            return
        self.heard_at = self._clock.seconds()
        self._pinged_at = None
        for number, layer in enumerate(self._layers):
            was_open = layer.is_open
            data, reply = layer.received(data)
            if reply:
                self._write(self._layers[:number], reply)
            if layer.fault:
                self.end(layer.fault)
                return
            if not layer.is_open:
                return
            if not was_open:
                self._begin(number + 1)
        if data:
            self._process(data)

    def connectionLost(self, reason: Failure | None = None) -> None:
        """Close the link."""
        cancel(self._closing)
        self._finish(
            "the connection was lost"
            if self.socket.is_open
            else "the other end closed the connection before a tunnel was open"
        )

    def pauseProducing(self) -> None:
        """Queue datagrams, because the buffer of the transport is full."""
        if self._paused_at is None:
            self._paused_at = self._clock.seconds()

    def resumeProducing(self) -> None:
        """Send queued datagrams, because the transport accepts more."""
        self._paused_at = None
        while self.is_open and self._paused_at is None and (self._short or self._long):
            datagram = (self._short or self._long).popleft()
            self._waiting -= len(datagram)
            self._write_framed(datagram)

    def stopProducing(self) -> None:
        """Do nothing; ``connectionLost`` follows."""

    # -- private ----------------------------------------------------------------------------------------------------

    def _begin(self, number: int) -> None:
        """Send the first bytes of a layer, or of the WebSocket inside all layers."""
        part = self._layers[number] if number < len(self._layers) else self.socket
        words = part.opening()
        if words:
            self._write(self._layers[:number], words)

    def _process(self, data: bytes) -> None:
        was_open = self.socket.is_open
        datagrams, reply = self.socket.received(data)
        if reply:
            self._write(self._layers, reply)
        if self.socket.is_open and not was_open:
            if not self._owner.link_open(self):
                self.end("too many connections")
                return
            self.resumeProducing()
        for datagram in datagrams:
            if self.is_over:
                return
            self._owner.link_said(self, datagram)
        if self.socket.fault:
            self.end(self.socket.fault)

    def _ping(self, now: float) -> None:
        if self._pinged_at is None:
            self._pinged_at = now
            self._write(self._layers, self.socket.ping())

    def _write_framed(self, datagram: bytes) -> None:
        self._write(self._layers, self.socket.framed(datagram))

    def _write(self, layers: Sequence[Layer], data: bytes) -> None:
        for layer in reversed(layers):
            data = layer.wrapped(data)
        transport: Any = self.transport
        transport.write(data)

    def _finish(self, why: str) -> None:
        if not self.is_over:
            self.is_over = True
            self._short.clear()
            self._long.clear()
            self._waiting = 0
            self._owner.link_over(self, why)
