"""The live side: native resources beside Flask, for the state (server-sent events) and the cameras (long polls).

A stream that goes through a WSGI worker holds it for good, so none does.  A client that reads slowly is skipped and
counted, never queued for: what it gets next is the newest.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from typing import Any

from twisted.internet.interfaces import IDelayedCall, IPushProducer, IReactorTime
from twisted.logger import Logger
from twisted.web.http import Request
from twisted.web.resource import Resource
from twisted.web.server import NOT_DONE_YET
from zope.interface import implementer

from webnode.camera import Camera, FrameSource
from webnode.errors import Refusal
from webnode.resource import JsonResource, answer
from webnode.state import State

BEAT_S = 0.5
PACE_S = 0.1
MAX_VIEWERS = 256
MAX_WAITING = 64


@implementer(IPushProducer)
class Viewer:
    """One open event stream; the transport pauses it while its client does not keep up."""

    def __init__(self, request: Request) -> None:
        self.request = request
        self.paused = False
        self.skipped = 0
        self.seen: dict[str, str] = {}

    def pauseProducing(self) -> None:
        """Stop writing: the client is behind."""
        self.paused = True

    def resumeProducing(self) -> None:
        """Go on writing."""
        self.paused = False

    def stopProducing(self) -> None:
        """Stop writing for good."""
        self.paused = True

    def offer(self, event: str, words: str) -> None:
        """Write an event if it is news to this viewer, or count that it was skipped."""
        if self.seen.get(event) == words:
            return
        if self.paused:
            self.skipped += 1
            return
        self.seen[event] = words
        self.request.write(f"event: {event}\ndata: {words}\n\n".encode())


class Events(JsonResource):
    """``/events``: the full state, then each change, at most ten a second; a ``beat`` each half second.

    Events are ``state`` (``state.state_of``), ``yard`` (the overhead snapshot, or null) and ``beat`` (``now`` in unix
    seconds, ``skipped``: how many events this slow client missed).  ``read`` and ``yard`` are asked only while somebody
    looks.
    """

    isLeaf = True
    _log = Logger()

    def __init__(
        self,
        read: Callable[[], State],
        clock: IReactorTime,
        wall: Callable[[], float],
        yard: Callable[[], Mapping[str, Any] | None] = lambda: None,
    ) -> None:
        super().__init__()
        self._sources: dict[str, Callable[[], Any]] = {"state": read, "yard": yard}
        self._clock = clock
        self._wall = wall
        self._viewers: list[Viewer] = []
        self._turn: IDelayedCall | None = None
        self._beat_at = 0.0
        self._failing: dict[str, bool] = {}

    @property
    def viewers(self) -> int:
        """How many streams are open."""
        return len(self._viewers)

    def render_GET(self, request: Request) -> int | bytes:
        """Open a stream."""
        if len(self._viewers) >= MAX_VIEWERS:
            return answer(request, Refusal("events", "too many pages are open", "close one and try again", 503))
        request.setHeader("Content-Type", "text/event-stream; charset=utf-8")
        request.setHeader("Cache-Control", "no-store")
        request.setHeader("X-Accel-Buffering", "no")
        viewer = Viewer(request)
        self._viewers.append(viewer)
        request.notifyFinish().addBoth(lambda _: self._close(viewer))
        request.registerProducer(viewer, True)
        request.write(b"retry: 1000\n\n")
        for event, words in self._news().items():
            viewer.offer(event, words)
        self._beat([viewer])
        if self._turn is None:
            self._beat_at = self._clock.seconds() + BEAT_S
            self._turn = self._clock.callLater(PACE_S, self._tick)
        return NOT_DONE_YET

    def close(self) -> None:
        """End every stream."""
        for viewer in list(self._viewers):
            viewer.request.unregisterProducer()
            viewer.request.finish()

    def _tick(self) -> None:
        self._turn = self._clock.callLater(PACE_S, self._tick)
        for event, words in self._news().items():
            for viewer in list(self._viewers):
                viewer.offer(event, words)
        if self._clock.seconds() >= self._beat_at:
            self._beat_at = self._clock.seconds() + BEAT_S - PACE_S / 2
            self._beat(list(self._viewers))

    def _beat(self, viewers: list[Viewer]) -> None:
        for viewer in viewers:
            viewer.offer("beat", json.dumps({"now": round(self._wall(), 3), "skipped": viewer.skipped}))

    def _news(self) -> dict[str, str]:
        news: dict[str, str] = {}
        for event, source in self._sources.items():
            try:
                news[event] = json.dumps(source(), separators=(",", ":"), allow_nan=False)
            except Exception:
                # The sources are the front door's; a store that cannot be read for a moment must not end the streams.
                if not self._failing.get(event):
                    self._log.failure("the page's {event} cannot be read; the streams go on without", event=event)
                self._failing[event] = True
            else:
                self._failing[event] = False
        return news

    def _close(self, viewer: Viewer) -> None:
        self._viewers.remove(viewer)
        if not self._viewers and self._turn is not None:
            self._turn.cancel()
            self._turn = None


class Shots(JsonResource):
    """``/shot/<device>?after=N&viewer=V``: the newest picture whose number is not N, as soon as there is one.

    The answer carries ``X-Seq``, the number to give as ``after`` next.  204 after five seconds without a new
    picture.  A viewer that asks again while its last question is open gets the older one answered with 204: one
    picture in flight, never a queue.
    """

    def __init__(self, frames: FrameSource, clock: IReactorTime) -> None:
        super().__init__()
        self._frames = frames
        self._clock = clock
        self._cameras: dict[str, Camera] = {}

    @property
    def watched(self) -> list[str]:
        """The devices whose pictures are wanted now."""
        return list(self._cameras)

    def getChild(self, path: bytes, request: Request) -> Resource:
        """The camera of one device."""
        return _Shot(self, path.decode("ascii", "replace"))

    def ask(self, uuid: str, request: Request) -> int | bytes:
        """Answer at once if the newest picture is news, else when the next one comes."""
        camera = self._cameras.get(uuid)
        if camera is None:
            try:
                camera = Camera(self._clock, lambda seen: self._frames.watch(uuid, seen), lambda: self._end(uuid))
            except Refusal as refusal:
                return answer(request, refusal)
            self._cameras[uuid] = camera
        if len(camera.waiting) >= MAX_WAITING:
            return answer(request, Refusal("shot", "too many look at this camera", "close one and try again", 503))
        camera.wait(request)
        return NOT_DONE_YET

    def close(self) -> None:
        """End every question and every upstream."""
        for camera in list(self._cameras.values()):
            camera.close()

    def _end(self, uuid: str) -> None:
        self._cameras.pop(uuid, None)


class _Shot(JsonResource):
    isLeaf = True

    def __init__(self, shots: Shots, uuid: str) -> None:
        super().__init__()
        self._shots = shots
        self._uuid = uuid

    def render_GET(self, request: Request) -> int | bytes:
        return self._shots.ask(self._uuid, request)
