"""The dog's ports: commands over TCP, camera pictures over TCP or UDP."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

from twisted.internet.defer import Deferred, succeed
from twisted.internet.interfaces import IReactorTime
from twisted.internet.protocol import DatagramProtocol

from drivers.aibo.picture import REQUEST, Closing, Message, Picture, PictureReader, decode_message
from drivers.errors import BadFrame
from drivers.link import Connector, Link, Reconnector
from drivers.timer import Timer

RETRY_DELAYS_S = (0.5, 1.0, 2.0, 5.0)
"""Delays before reconnecting, as in the dog's own clients: a port that was just closed accepts only after a while."""
FLUSH_S = 1.0
REQUEST_INTERVAL_S = 0.5
"""Interval in seconds at which datagrams are requested until they arrive, and again when they stop arriving."""
SILENCE_S = 2.0


class Port:
    """A connection to one TCP port, reopened whenever it is lost; the data is not interpreted."""

    def __init__(
        self,
        connector: Connector,
        clock: IReactorTime,
        address: tuple[str, int],
        on_up: Callable[[], None],
        on_down: Callable[[], None],
        on_bytes: Callable[[bytes], None],
    ) -> None:
        self.opened_at: float | None = None
        self._connector = connector
        self._clock = clock
        self._address = address
        self._on_up = on_up
        self._on_down = on_down
        self._on_bytes = on_bytes
        self._reconnector: Reconnector | None = None
        self._link: Link | None = None

    @property
    def number(self) -> int:
        """The port number."""
        return self._address[1]

    @property
    def link(self) -> Link | None:
        """The current link, or None."""
        return self._link

    @property
    def is_up(self) -> bool:
        """Whether the link is open."""
        return self._link is not None

    def open(self) -> None:
        """Connect now, and keep connecting; an open link stays open."""
        if self._link is not None:
            return
        if self._reconnector is not None:
            self._reconnector.disconnect()
        else:
            self.opened_at = self._clock.seconds()
        self._reconnector = self._connector.connect(*self._address, self)

    def send(self, data: bytes) -> None:
        """Send bytes; does nothing if there is no link."""
        if self._link is not None:
            self._link.send(data)

    def drop(self) -> None:
        """Close the link; it is reopened after a delay."""
        if self._link is not None:
            self._link.close()

    def close(self) -> Deferred[None]:
        """Close permanently after pending data is written; wait at most ``FLUSH_S`` for that."""
        reconnector, self._reconnector = self._reconnector, None
        if reconnector is None:
            return succeed(None)
        link, self.opened_at = self._link, None
        closed = reconnector.disconnect()
        if link is not None and not closed.called:
            timer = Timer(self._clock)
            timer.set(FLUSH_S, link.close)
            closed.addCallback(lambda _: timer.cancel())
        return closed

    def link_up(self, link: Link) -> None:
        """Use the new link; called by the link."""
        self._link = link
        self._on_up()

    def link_down(self) -> None:
        """Drop the link; called by the link."""
        self._link = None
        self.opened_at = None if self._reconnector is None else self._clock.seconds()
        self._on_down()

    def data_received(self, data: bytes) -> None:
        """Process received bytes; called by the link."""
        if self._reconnector is not None:
            self._on_bytes(data)


class DatagramConnector(Protocol):
    """Opens links for datagrams."""

    def open(self, host: str, port: int, received: Callable[[bytes], None]) -> Link:
        """Return a link to ``host``; datagrams from it are passed to ``received``."""


class UdpConnector:
    """Opens UDP links on ``reactor``, from a port that the system chooses."""

    def __init__(self, reactor: Any) -> None:
        self._reactor = reactor

    def open(self, host: str, port: int, received: Callable[[bytes], None]) -> Link:
        """Return a link to ``host``; datagrams from it are passed to ``received``."""
        link = _UdpLink(host, port, received)
        self._reactor.listenUDP(0, link, maxPacketSize=65536)
        return link


class _UdpLink(DatagramProtocol):
    noisy = False
    is_busy = False

    def __init__(self, host: str, port: int, received: Callable[[bytes], None]) -> None:
        self._address = (host, port)
        self._on_datagram = received

    def startProtocol(self) -> None:
        transport: Any = self.transport
        transport.connect(*self._address)

    def datagramReceived(self, datagram: bytes, addr: object) -> None:
        self._on_datagram(datagram)

    def connectionRefused(self) -> None:
        """Ignore the error: the server does not listen yet, and the request will be repeated."""

    def send(self, data: bytes) -> None:
        transport: Any = self.transport
        if transport is not None:
            transport.write(data)

    def close(self) -> None:
        if self.transport is not None:
            self.transport.stopListening()


class Camera:
    """Receives pictures and passes each to ``on_picture``; invalid data is counted in ``bad_frames``."""

    def __init__(
        self,
        connector: Connector,
        clock: IReactorTime,
        address: tuple[str, int],
        on_picture: Callable[[Picture], None],
        datagrams: DatagramConnector | None = None,
    ) -> None:
        self.bad_frames = 0
        self.bytes = 0
        self.port = Port(connector, clock, address, self._on_up, lambda: None, self._on_bytes)
        self._clock = clock
        self._address = address
        self._on_picture = on_picture
        self._datagrams = datagrams
        self._reader = PictureReader()
        self._link: Link | None = None
        self._request_timer = Timer(clock)
        self._last_data_at = -SILENCE_S

    @property
    def is_silent(self) -> bool:
        """Whether datagrams were requested, but no datagram has arrived for ``SILENCE_S``."""
        return self._link is not None and self._clock.seconds() - self._last_data_at >= SILENCE_S

    def open(self) -> None:
        """Start receiving pictures; does nothing if already started."""
        if self._datagrams is None:
            self.port.open()
        elif self._link is None:
            self._link = self._datagrams.open(*self._address, self._on_datagram)
            self._request_pictures()

    def close(self) -> Deferred[None]:
        """Stop receiving pictures; the camera can be opened again."""
        self._request_timer.cancel()
        link, self._link = self._link, None
        if link is not None:
            link.close()
        return self.port.close() if self._datagrams is None else succeed(None)

    def _on_up(self) -> None:
        self._reader = PictureReader()

    def _on_bytes(self, data: bytes) -> None:
        self.bytes += len(data)
        reader = self._reader
        before = reader.bad_frames
        for message in reader.read(data):
            self._on_message(message)
        self.bad_frames += reader.bad_frames - before

    def _on_datagram(self, data: bytes) -> None:
        if self._link is None:
            return
        self.bytes += len(data)
        self._last_data_at = self._clock.seconds()
        try:
            message = decode_message(data)
        except BadFrame:
            self.bad_frames += 1
            return
        self._on_message(message)

    def _on_message(self, message: Message) -> None:
        if isinstance(message, Picture):
            self._on_picture(message)
        elif isinstance(message, Closing):
            self._last_data_at = -SILENCE_S
            self.port.drop()

    def _request_pictures(self) -> None:
        self._request_timer.set(REQUEST_INTERVAL_S, self._request_pictures)
        if self._link is not None and self.is_silent:
            self._link.send(REQUEST)
