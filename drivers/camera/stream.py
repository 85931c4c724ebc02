"""Stream: pictures of a camera that serves them over HTTP; it is called, and called again, through a ``Connector``."""

from __future__ import annotations

from twisted.internet.defer import Deferred, succeed
from twisted.internet.interfaces import IReactorTime
from twisted.logger import Logger

from drivers.camera import codec
from drivers.camera.option import Place
from drivers.camera.shots import Shot
from drivers.camera.thread import Retry, Viewer
from drivers.errors import BadFrame
from drivers.link import Connector, Line, Link
from drivers.timer import Timer
from formats.jpeg import size_of

SILENCE_S = 5.0
"""Without a whole picture for so long the camera is hung up on, and called again."""


class StreamFilm:
    """A wish for the pictures at ``place``; ``size`` is what they are described as.

    A camera sends as it likes: of pictures above the wanted rate each that is too early is dropped.  With none wanted
    it is hung up on, but for the first one, which tells that the camera is there.
    """

    log = Logger()

    def __init__(self, place: Place, size: tuple[int, int], connector: Connector, clock: IReactorTime) -> None:
        self.dropped = 0
        """Pictures above the wanted rate."""
        self._place = place
        self._size = size
        self._connector = connector
        self._clock = clock
        self._viewer: Viewer | None = None
        self._fps = 0.0
        self._due = 0.0
        self._has_shown = False
        self._retry = Retry()
        self._call: _Call | None = None
        self._timer = Timer(clock)

    def start(self, viewer: Viewer, fps: float) -> None:
        """Begin."""
        self._viewer, self._fps = viewer, fps
        self._ring()

    def set_fps(self, fps: float) -> None:
        """So many a second from now on; 0: none."""
        self._fps = fps
        self._due = 0.0
        if self._viewer is None:
            return
        if fps <= 0 and self._has_shown:
            self._hang_up()
        elif fps > 0 and not self._timer.is_set:
            self._ring()

    def stop(self) -> Deferred[None]:
        """End; fires when the link is closed."""
        self._viewer = None
        return self._hang_up()

    # -- told by a call ---------------------------------------------------------------------------------------------

    def heard(self, call: _Call, data: bytes) -> None:
        """Take bytes of the camera's answer."""
        if call is not self._call:
            return
        try:
            pictures = call.reader.read(data)
        except BadFrame as error:
            self._give_up(str(error))
            return
        for jpeg in pictures:
            self._on_picture(jpeg)
            if call is not self._call:
                return
        if call.reader.is_over:
            self._give_up("it has ended its stream")

    def lost(self, call: _Call) -> None:
        """Learn that the camera, or the network, has hung up."""
        if call is self._call:
            self._give_up("it has hung up")

    def _ring(self) -> None:
        place = self._place
        call = self._call = _Call(self, codec.request(place.name, place.path, place.login))
        self._timer.set(SILENCE_S, self._on_silence)
        call.line = self._connector.call(place.host, place.port, call)

    def _on_picture(self, jpeg: bytes) -> None:
        viewer, size = self._viewer, size_of(jpeg)
        assert viewer is not None
        if size is None:
            viewer.spoilt(f"a picture of {len(jpeg)} bytes is no whole JPEG")
            return
        self._retry.succeed()
        self._timer.set(SILENCE_S, self._on_silence)
        now = self._clock.seconds()
        interval = 1.0 / self._fps if self._fps > 0 else 0.0
        if now < self._due:
            self.dropped += 1
            return
        # Counted from when it was due: one that came late does not make the next one early.
        self._due = max(self._due + interval, now)
        self._has_shown = True
        if size != self._size:
            self._size = size
            told = "{place}: its pictures are {width} x {height}: write width = {width}, height = {height}"
            self.log.warn(told, place=self._place.name, width=size[0], height=size[1])
        viewer.shown(Shot(jpeg, *size))
        if self._fps <= 0:
            self._hang_up()

    def _on_silence(self) -> None:
        if self._call is not None and self._call.is_up:
            self._give_up(f"{self._place.name} answers, but no pictures come; serves it another already?")
        else:
            self._give_up(f"nothing answers at {self._place.name}; is it on, and in this network?")

    def _give_up(self, reason: str) -> None:
        self._hang_up()
        self._has_shown = False
        self._timer.set(self._retry.fail(), self._ring)
        if self._viewer is not None:
            self._viewer.gone(reason)

    def _hang_up(self) -> Deferred[None]:
        call, self._call = self._call, None
        self._timer.cancel()
        return succeed(None) if call is None or call.line is None else call.line.hang_up()


class _Call:
    """One try: what comes of an earlier one, which is still being closed, is not heard any more."""

    def __init__(self, film: StreamFilm, request: bytes) -> None:
        self.reader = codec.StreamReader()
        self.line: Line | None = None
        self.is_up = False
        self._film = film
        self._request = request

    def link_up(self, link: Link) -> None:
        """Ask for the stream; called by the line."""
        self.is_up = True
        link.send(self._request)

    def received(self, data: bytes) -> None:
        """Take bytes; called by the line."""
        self._film.heard(self, data)

    def link_down(self) -> None:
        """Learn that it is over; called by the line."""
        self._film.lost(self)
