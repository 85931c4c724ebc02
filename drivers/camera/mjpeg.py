"""Pictures of a camera that serves MJPEG over HTTP, with reconnects through a ``Connector``."""

from __future__ import annotations

from twisted.internet.defer import Deferred, succeed
from twisted.internet.interfaces import IReactorTime
from twisted.logger import Logger

from drivers.camera import codec
from drivers.camera.option import StreamAddress
from drivers.camera.picture_stream import Backoff, PictureReceiver
from drivers.camera.source import JpegPicture
from drivers.errors import BadFrame
from drivers.link import Connector, Link, Reconnector
from drivers.timer import Timer
from formats.jpeg import read_size

PICTURE_TIMEOUT_S = 5.0
"""Seconds without a complete picture after which the driver reconnects."""


class MjpegStream:
    """The pictures at ``address``; ``size`` is their width and height according to the options.

    A camera sends at its own rate; pictures that exceed the requested rate are dropped. At rate 0 the connection is
    closed after the first picture, which proves that the camera is present.
    """

    log = Logger()

    def __init__(
        self, address: StreamAddress, size: tuple[int, int], connector: Connector, clock: IReactorTime
    ) -> None:
        self.dropped = 0
        """Number of pictures that exceeded the requested rate."""
        self._address = address
        self._size = size
        self._connector = connector
        self._clock = clock
        self._receiver: PictureReceiver | None = None
        self._fps = 0.0
        self._due_at = 0.0
        self._has_shown = False
        self._backoff = Backoff()
        self._attempt: _Attempt | None = None
        self._timer = Timer(clock)

    def start(self, receiver: PictureReceiver, fps: float) -> None:
        """Connect and start to deliver pictures."""
        self._receiver, self._fps = receiver, fps
        self._connect()

    def set_fps(self, fps: float) -> None:
        """Set the frame rate in pictures per second; 0 stops."""
        self._fps = fps
        self._due_at = 0.0
        if self._receiver is None:
            return
        if fps <= 0 and self._has_shown:
            self._disconnect()
        elif fps > 0 and not self._timer.is_set:
            self._connect()

    def stop(self) -> Deferred[None]:
        """Stop; fires when the link is closed."""
        self._receiver = None
        return self._disconnect()

    # -- called by an attempt ---------------------------------------------------------------------------------------

    def on_data(self, attempt: _Attempt, data: bytes) -> None:
        """Process bytes of the camera's answer."""
        if attempt is not self._attempt:
            return
        try:
            pictures = attempt.reader.read(data)
        except BadFrame as error:
            self._fail(str(error))
            return
        for jpeg in pictures:
            self._on_picture(jpeg)
            if attempt is not self._attempt:
                return
        if attempt.reader.is_over:
            self._fail("it ended the stream")

    def on_connection_lost(self, attempt: _Attempt) -> None:
        """Handle the loss of the connection."""
        if attempt is self._attempt:
            self._fail("it closed the connection")

    def _connect(self) -> None:
        address = self._address
        attempt = self._attempt = _Attempt(self, codec.encode_request(address.name, address.path, address.login))
        self._timer.set(PICTURE_TIMEOUT_S, self._on_silence)
        attempt.reconnector = self._connector.connect(address.host, address.port, attempt)

    def _on_picture(self, jpeg: bytes) -> None:
        receiver, size = self._receiver, read_size(jpeg)
        assert receiver is not None
        if size is None:
            receiver.on_invalid_picture(f"a picture of {len(jpeg)} bytes is not a complete JPEG")
            return
        self._backoff.reset()
        self._timer.set(PICTURE_TIMEOUT_S, self._on_silence)
        now = self._clock.seconds()
        interval = 1.0 / self._fps if self._fps > 0 else 0.0
        if now < self._due_at:
            self.dropped += 1
            return
        # The next due time counts from the last one, so that a late picture does not change the rate.
        self._due_at = max(self._due_at + interval, now)
        self._has_shown = True
        if size != self._size:
            self._size = size
            warning = "{place}: its pictures are {width} x {height}: write width = {width}, height = {height}"
            self.log.warn(warning, place=self._address.name, width=size[0], height=size[1])
        receiver.on_picture(JpegPicture(jpeg, *size))
        if self._fps <= 0:
            self._disconnect()

    def _on_silence(self) -> None:
        if self._attempt is not None and self._attempt.is_up:
            self._fail(f"{self._address.name} answers, but no pictures come; does it already serve another client?")
        else:
            self._fail(f"nothing answers at {self._address.name}; is it on, and in this network?")

    def _fail(self, reason: str) -> None:
        self._disconnect()
        self._has_shown = False
        self._timer.set(self._backoff.increase(), self._connect)
        if self._receiver is not None:
            self._receiver.on_source_lost(reason)

    def _disconnect(self) -> Deferred[None]:
        attempt, self._attempt = self._attempt, None
        self._timer.cancel()
        return succeed(None) if attempt is None or attempt.reconnector is None else attempt.reconnector.disconnect()


class _Attempt:
    """One connection attempt; data of an earlier attempt, whose connection is still being closed, is ignored."""

    def __init__(self, stream: MjpegStream, request: bytes) -> None:
        self.reader = codec.StreamReader()
        self.reconnector: Reconnector | None = None
        self.is_up = False
        self._stream = stream
        self._request = request

    def link_up(self, link: Link) -> None:
        self.is_up = True
        link.send(self._request)

    def data_received(self, data: bytes) -> None:
        self._stream.on_data(self, data)

    def link_down(self) -> None:
        self._stream.on_connection_lost(self)
