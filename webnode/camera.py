"""Serve the newest picture of each device by long polling; an upstream is open only while a browser watches."""

from __future__ import annotations

from collections.abc import Callable

from twisted.internet.interfaces import IDelayedCall, IReactorTime
from twisted.web.http import Request

from formats.jpeg import read_size
from webnode.errors import Refusal
from webnode.resource import read_argument

POLL_S = 5.0
LINGER_S = 2.0
MAX_FRAME_BYTES = 1 << 20

OnFrame = Callable[[int, bytes, float], None]
"""Called with the number of a picture, the picture as a JPEG, and the seconds since it was taken."""
WaitingRequest = tuple[Request, bytes, IDelayedCall]


class CameraStream:
    """The newest picture of one device, and the requests that wait for the next one.

    ``open_upstream`` may raise ``Refusal``.  An upstream that is silent for ``POLL_S`` is reopened, because the device
    may have a new address.  The stream ends two seconds after its last request.
    """

    def __init__(
        self, clock: IReactorTime, open_upstream: Callable[[OnFrame], Callable[[], None]], on_end: Callable[[], None]
    ):
        self._clock = clock
        self._open_upstream = open_upstream
        self._on_end = on_end
        self._opened_at = clock.seconds()
        self._newest: tuple[int, bytes, float] | None = None
        self._received_at = -POLL_S
        self._linger: IDelayedCall | None = None
        self._is_ended = False
        self.waiting: list[WaitingRequest] = []
        self._stop_upstream = open_upstream(self.on_frame)

    def wait(self, request: Request) -> None:
        """Answer ``request`` with the first picture that its viewer has not seen."""
        viewer = read_argument(request, b"viewer")
        for entry in [entry for entry in self.waiting if viewer and entry[1] == viewer]:
            self._release(entry)
        if self._linger is not None:
            self._linger.cancel()
            self._linger = None
        if self._newest is not None and read_argument(request, b"after") != str(self._newest[0]).encode():
            self._send(request)
            self._start_linger()
            return
        entry = (request, viewer, self._clock.callLater(POLL_S, lambda: self._give_up(entry)))
        self.waiting.append(entry)
        request.notifyFinish().addErrback(lambda _: self._forget(entry))

    def on_frame(self, seq: int, jpeg: bytes, age: float) -> None:
        """Take a picture that is ``age`` seconds old; drop it if it is late, too large or not a JPEG."""
        if self._is_ended or len(jpeg) > MAX_FRAME_BYTES or read_size(jpeg) is None:
            return
        now = self._clock.seconds()
        self._newest, self._received_at = (seq, jpeg, now - age), now
        waiting, self.waiting = self.waiting, []
        for request, _, deadline in waiting:
            deadline.cancel()
            self._send(request)
        self._start_linger()

    def close(self) -> None:
        """Answer waiting requests with 204 and end the upstream."""
        for entry in list(self.waiting):
            self._release(entry)
        if self._linger is not None:
            self._linger.cancel()
        self._end()

    def _send(self, request: Request) -> None:
        assert self._newest is not None
        seq, jpeg, at = self._newest
        request.setHeader("Content-Type", "image/jpeg")
        request.setHeader("Cache-Control", "no-store")
        request.setHeader("X-Seq", str(seq))
        request.setHeader("X-Age", f"{self._clock.seconds() - at:.3f}")
        request.setHeader("Content-Length", str(len(jpeg)))
        request.write(jpeg)
        request.finish()

    def _give_up(self, entry: WaitingRequest) -> None:
        self._release(entry)
        if self._clock.seconds() - max(self._received_at, self._opened_at) < POLL_S:
            return
        self._stop_upstream()
        self._stop_upstream = lambda: None
        try:
            self._stop_upstream = self._open_upstream(self.on_frame)
            self._opened_at = self._clock.seconds()
        except Refusal:
            self.close()

    def _release(self, entry: WaitingRequest) -> None:
        self._forget(entry)
        entry[0].setResponseCode(204)
        entry[0].finish()

    def _forget(self, entry: WaitingRequest) -> None:
        if entry in self.waiting:
            self.waiting.remove(entry)
        if entry[2].active():
            entry[2].cancel()
        self._start_linger()

    def _start_linger(self) -> None:
        if not self.waiting and self._linger is None:
            self._linger = self._clock.callLater(LINGER_S, self._end)

    def _end(self) -> None:
        self._linger = None
        self._is_ended = True
        self._stop_upstream()
        self._on_end()
