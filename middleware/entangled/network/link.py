"""Link: one connection of a tunnel, which carries datagrams as a WebSocket, and what it keeps to.

A stream delivers everything, in order, however late; for a heartbeat that is worse than a loss.  So little waits here:
what does not fit is dropped, the newest first, and what is short goes before what is long.
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
"""Heartbeats, receipts, greetings and most questions have fewer bytes; parts of parcels have 1400."""
MAX_WAITING, MAX_LONG = 40 * 1024, 32 * 1024
"""Bytes that wait here, and those of them that are long."""
MAX_SENDING = 16 * 1024
"""Bytes that wait in the transport, where nothing overtakes them; together with the others less than 64 KiB."""
QUIET_S, IDLE_S = 5.0, 20.0
"""A link on which nothing came for so long is pinged, while something is sent on it, and else."""
PONG_S = 5.0
"""Who answers no ping for so long is gone, though the connection stays up."""
STALL_S = 30.0
"""Who takes nothing for so long is given up."""
CLOSE_S = 2.0
"""So long the last words may take."""


class Owner(Protocol):
    """Whose link it is."""

    def link_open(self, link: Link) -> bool:
        """Learn that datagrams may pass; False ends the link."""

    def link_said(self, link: Link, datagram: bytes) -> None:
        """Take a datagram."""

    def link_over(self, link: Link, why: str) -> None:
        """Learn that it is over; called once."""


@implementer(IPushProducer)
class Link(StreamProtocol):
    """One connection; ``address`` is what stands for the node at its other end, ``host`` where its stream came from.

    ``layers`` lie around the WebSocket, the outermost first.  ``dropped`` counts the datagrams for which there was no
    room.
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
        """Whether datagrams pass."""
        return self.socket.is_open and not self.is_over

    @property
    def is_closing(self) -> bool:
        """Whether its last words are still on their way."""
        return self._closing is not None and self._closing.active()

    @property
    def waiting(self) -> int:
        """Bytes that wait here."""
        return self._waiting

    def send(self, datagram: bytes) -> None:
        """Send a datagram now, or soon, or drop it."""
        now = self._clock.seconds()
        if self.is_open and self._paused_at is None:
            self._put(datagram)
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
        """See whether the other end is still there; called every second or so."""
        if not self.is_open:
            return
        if self._pinged_at is not None and now - self._pinged_at > PONG_S:
            self.end("it answers no ping", is_rude=True)
        elif self._paused_at is not None and now - self._paused_at > STALL_S:
            self.end("it takes nothing", is_rude=True)
        elif now - self.heard_at > IDLE_S:
            self._ping(now)

    def end(self, why: str, code: int = NORMAL, is_rude: bool = False) -> None:
        """Say goodbye and hang up; at once and without a word where ``is_rude``."""
        if self.is_over:
            return
        transport: Any = self.transport
        if self.is_open and not is_rude and self._paused_at is None:
            self._write(self._layers, self.socket.closing(code))
        self._over(why)
        if transport is None:
            return
        transport.unregisterProducer()
        if is_rude or self._paused_at is not None:
            transport.abortConnection()
        else:
            self._closing = self._clock.callLater(CLOSE_S, transport.abortConnection)
            transport.loseConnection()

    def forget(self) -> None:
        """Leave nothing on the clock; who takes the last words takes them."""
        cancel(self._closing)

    # -- called by the stream ---------------------------------------------------------------------------------------

    def connectionMade(self) -> None:
        """Begin with the outermost layer."""
        transport: Any = self.transport
        if self.is_over:
            transport.abortConnection()
            return
        transport.bufferSize = MAX_SENDING
        transport.registerProducer(self, True)
        self._begin(0)

    def dataReceived(self, data: bytes) -> None:
        """Take bytes through all layers."""
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
            self._heard(data)

    def connectionLost(self, reason: Failure | None = None) -> None:
        """The stream is gone."""
        cancel(self._closing)
        self._over("the connection was lost" if self.socket.is_open else "hung up before a tunnel began")

    def pauseProducing(self) -> None:
        """The transport has enough for now."""
        if self._paused_at is None:
            self._paused_at = self._clock.seconds()

    def resumeProducing(self) -> None:
        """The transport takes more."""
        self._paused_at = None
        while self.is_open and self._paused_at is None and (self._short or self._long):
            datagram = (self._short or self._long).popleft()
            self._waiting -= len(datagram)
            self._put(datagram)

    def stopProducing(self) -> None:
        """The transport takes no more."""

    # -- inside -----------------------------------------------------------------------------------------------------

    def _begin(self, number: int) -> None:
        """Let the next layer say its first words, or the WebSocket, which lies in all of them."""
        part = self._layers[number] if number < len(self._layers) else self.socket
        words = part.opening()
        if words:
            self._write(self._layers[:number], words)

    def _heard(self, data: bytes) -> None:
        was_open = self.socket.is_open
        datagrams, reply = self.socket.received(data)
        if reply:
            self._write(self._layers, reply)
        if self.socket.is_open and not was_open:
            if not self._owner.link_open(self):
                self.end("there are too many")
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

    def _put(self, datagram: bytes) -> None:
        self._write(self._layers, self.socket.framed(datagram))

    def _write(self, layers: Sequence[Layer], data: bytes) -> None:
        for layer in reversed(layers):
            data = layer.wrapped(data)
        transport: Any = self.transport
        transport.write(data)

    def _over(self, why: str) -> None:
        if not self.is_over:
            self.is_over = True
            self._short.clear()
            self._long.clear()
            self._waiting = 0
            self._owner.link_over(self, why)
