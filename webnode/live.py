"""Serve the state (server-sent events) and the cameras (long polling) as native Twisted resources.

A stream would occupy a WSGI worker until its end, so streams bypass Flask.  Nothing is queued for a client that
reads slowly: the client later gets the changes that it missed, or the whole state if that is smaller.
"""

from __future__ import annotations

import socket
from collections.abc import Callable, Mapping
from dataclasses import asdict
from functools import partial
from typing import Any

from twisted.internet.interfaces import IDelayedCall, IPushProducer, IReactorTime
from twisted.logger import Logger
from twisted.protocols.policies import ProtocolWrapper
from twisted.web.http import Request
from twisted.web.resource import Resource
from twisted.web.server import NOT_DONE_YET
from zope.interface import implementer

from webnode.camera import CameraStream, OnFrame
from webnode.errors import Refusal
from webnode.request_guard import choose_token
from webnode.resource import JsonResource, read_argument, write_refusal
from webnode.services import Services
from webnode.state import State
from webnode.state_journal import Journal, encode_json

BEAT_S = 0.2
CHANGES_INTERVAL_S = 0.1
READ_PAUSE_FACTOR = 4
"""For a large team: pause between two readings of the state, as a multiple of the duration of a reading."""
CHECK_S = 1.0
"""Interval in seconds at which the sessions of open streams are checked."""
RENEWAL_LEAD_S = 3600.0
"""Seconds before the end of a session at which the page has to renew it."""
IDLE_S = 1.0
"""Interval of reading the state without any stream, for the event log and to expire departed devices."""
MAX_VIEWERS = 256
MAX_WAITING = 256
MAX_NEW_ENTRIES = 100
"""Number of event log entries sent to a new page."""
SEND_BUFFER_BYTES, KERNEL_BUFFER_BYTES = 4096, 16384
"""Send buffer limits in bytes for a slow client, here and in the kernel: buffered data would be seconds old."""

StreamCamera = Callable[[str, OnFrame], Callable[[], None]]
"""Streams the camera of a device until the returned function is called; raises ``Refusal`` if it has none."""


@implementer(IPushProducer)
class Viewer:
    """One open event stream; the transport pauses it while its client reads too slowly.

    ``last_change`` is the number of the last change sent, ``last_entry`` the number of the last entry of the event log.
    """

    def __init__(self, request: Request, is_whole: bool = False, last_change: int = 0, ticket: str = "") -> None:
        self.request = request
        self.ticket = ticket
        self.is_renewing = False
        self.is_whole = is_whole
        self.last_change = last_change
        self.last_entry = 0
        self.paused = False
        self.skipped = 0
        self.sent_latest: dict[str, str] = {}

    def pauseProducing(self) -> None:
        """Pause: the client reads too slowly."""
        self.paused = True

    def resumeProducing(self) -> None:
        """Resume writing."""
        self.paused = False

    def stopProducing(self) -> None:
        """Stop writing; the connection has ended."""
        self.paused = True

    def shrink_buffers(self) -> None:
        """Shrink the send buffers of the connection."""
        transport: Any = getattr(self.request.channel, "transport", None)
        if isinstance(transport, ProtocolWrapper):
            # Over TLS the socket belongs to the wrapped transport.
            transport = transport.transport
        handle = transport.getHandle() if hasattr(transport, "getHandle") else None
        if isinstance(handle, socket.socket):
            transport.bufferSize = SEND_BUFFER_BYTES
            handle.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, KERNEL_BUFFER_BYTES)


class EventStreams(JsonResource):
    """``/events?since=ID&whole=1``: the state, then changes, at most ten per second; a ``beat`` five times a second.

    Events are ``state`` (``state.format_state``; ``resync`` is true if it replaces missed changes), ``change``
    (``journal.Change``), ``yard`` (the map of the simulator, or null), ``pages`` (the URLs of the team's pages),
    ``event`` (entries of the event log), ``ticket`` (the session expires at ``until`` and can be renewed) and ``beat``
    (``now`` in unix seconds, ``skipped``: the number of updates skipped for this slow client).  ``since``, or the
    header ``Last-Event-ID``, is the last id received: later changes are sent if they are still kept and smaller than
    the whole state.  With ``whole`` each change is a ``state``.  A stream ends with its session.

    ``version`` avoids reading the state: an equal value means that nothing has changed.
    """

    isLeaf = True
    _log = Logger()

    def __init__(
        self,
        read: Callable[[], State],
        clock: IReactorTime,
        wall: Callable[[], float],
        services: Services,
        version: Callable[[], object] | None = None,
    ) -> None:
        super().__init__()
        self._read = read
        self._clock = clock
        self._wall = wall
        self._services = services
        self._latest_sources: dict[str, Callable[[], Any]] = {
            "yard": lambda: services.control.get_map(),
            "pages": lambda: [asdict(page) for page in services.fallbacks.list_pages()],
        }
        self._version = version
        self._checked_at = 0.0
        self._known_version: object = None
        self._read_at = -IDLE_S
        self._read_duration_s = 0.0
        self._journal = Journal(f"{int(1000 * wall()):x}")
        self._encoded = (0, "")
        self._viewers: list[Viewer] = []
        self._timer: IDelayedCall | None = None
        self._beat_at = 0.0
        self._failing: dict[str, bool] = {}
        self._is_open = False

    @property
    def viewers(self) -> int:
        """The number of open streams."""
        return len(self._viewers)

    def start(self) -> None:
        """Start to read the state for the event log, also without any stream."""
        self._is_open = True
        self._schedule(IDLE_S)

    def render_GET(self, request: Request) -> int | bytes:
        """Open a stream."""
        if len(self._viewers) >= MAX_VIEWERS:
            return write_refusal(
                request, Refusal("events", "there are too many open pages", "close a page and try again", 503)
            )
        request.setHeader("Content-Type", "text/event-stream; charset=utf-8")
        request.setHeader("Cache-Control", "no-store")
        request.setHeader("X-Accel-Buffering", "no")
        since = request.getHeader("last-event-id") or read_argument(request, b"since").decode("ascii", "replace")
        is_whole = read_argument(request, b"whole") in (b"1", b"true")
        viewer = Viewer(request, is_whole, self._journal.parse_event_id(since), read_token(request))
        self._viewers.append(viewer)
        request.notifyFinish().addBoth(lambda _: self._close(viewer))
        viewer.shrink_buffers()
        request.registerProducer(viewer, True)
        self._read_state()
        text = [
            "retry: 1000\n\n",
            self._make_backlog(viewer, bool(since)),
            self._make_latest_events(viewer, self._encode_latest()),
        ]
        request.write("".join([*text, self._make_beat(viewer)]).encode())
        if len(self._viewers) == 1:
            self._beat_at = self._clock.seconds() + BEAT_S
            self._schedule(CHANGES_INTERVAL_S)
        return NOT_DONE_YET

    def close(self) -> None:
        """End every stream."""
        self._is_open = False
        for viewer in list(self._viewers):
            self._end(viewer)
        self._schedule(None)

    def _schedule(self, seconds: float | None) -> None:
        if self._timer is not None and self._timer.active():
            self._timer.cancel()
        self._timer = None if seconds is None else self._clock.callLater(seconds, self._tick)

    def _tick(self) -> None:
        self._schedule(CHANGES_INTERVAL_S if self._viewers else IDLE_S)
        self._read_state()
        if not self._viewers:
            return
        latest, is_beat = self._encode_latest(), self._clock.seconds() >= self._beat_at
        if is_beat:
            self._beat_at = self._clock.seconds() + BEAT_S - CHANGES_INTERVAL_S / 2
        is_checked = self._clock.seconds() >= self._checked_at
        if is_checked:
            self._checked_at = self._clock.seconds() + CHECK_S
        for viewer in list(self._viewers):
            if is_checked and not self._check_session(viewer):
                continue
            if viewer.paused:
                viewer.skipped += viewer.last_change < self._journal.n
                continue
            text = (
                self._make_backlog(viewer, True)
                + self._make_latest_events(viewer, latest)
                + (self._make_beat(viewer) if is_beat else "")
            )
            if text:
                viewer.request.write(text.encode())

    def _check_session(self, viewer: Viewer) -> bool:
        """End the stream of an expired session; announce the expiry of a session that can be renewed."""
        now = self._wall()
        user = self._services.sessions.authenticate(viewer.ticket, now)
        if user.role == "anyone":
            self._end(viewer)
            return False
        if (
            not viewer.is_renewing
            and not viewer.paused
            and user.until - now < RENEWAL_LEAD_S
            and user.until < user.limit
        ):
            viewer.is_renewing = True
            viewer.request.write(_format_event("ticket", encode_json({"until": user.until})).encode())
        return True

    def _end(self, viewer: Viewer) -> None:
        viewer.request.unregisterProducer()
        viewer.request.finish()

    def _read_state(self) -> None:
        """Read the state, if it may have changed."""
        now = self._clock.seconds()
        if now - self._read_at < READ_PAUSE_FACTOR * self._read_duration_s:
            return
        version = None if self._version is None else self._version()
        if version is not None and version == self._known_version and now - self._read_at < IDLE_S:
            return
        self._known_version, self._read_at = version, now
        with_state = self._call_logged("state", lambda: self._journal.add_state(self._read()))
        if with_state:
            self._services.event_log.record_state(self._journal.state, self._wall())
        self._read_duration_s = self._clock.seconds() - now

    def _make_backlog(self, viewer: Viewer, is_again: bool) -> str:
        """Return the missed changes or the whole state, if that is smaller, and the missed event log entries."""
        journal, text = self._journal, []
        missed = None if viewer.is_whole else journal.list_since(viewer.last_change)
        if (
            missed is not None
            and len(missed) > 1
            and sum(len(each.encoded) for each in missed) > len(self._encoded_state())
        ):
            missed = None
        if missed is not None:
            text = [f"id: {journal.make_event_id(each.n)}\nevent: change\ndata: {each.encoded}\n\n" for each in missed]
        elif viewer.last_change < journal.n:
            start = "true," if is_again and not viewer.is_whole else "false,"
            event_id = journal.make_event_id(journal.n)
            text = [f'id: {event_id}\nevent: state\ndata: {{"resync":{start}{self._encoded_state()}\n\n']
        viewer.last_change = journal.n
        entries = self._services.event_log.list_since(viewer.last_entry)[-MAX_NEW_ENTRIES:]
        if entries:
            viewer.last_entry = entries[-1].n
            text.append(_format_event("event", encode_json([asdict(entry) for entry in entries])))
        return "".join(text)

    def _encoded_state(self) -> str:
        """Return the whole state as JSON without its first brace, encoded once for all viewers."""
        if self._encoded[0] != self._journal.n:
            self._encoded = (self._journal.n, encode_json(self._journal.state)[1:])
        return self._encoded[1]

    def _make_latest_events(self, viewer: Viewer, latest: Mapping[str, str]) -> str:
        """Return the newest of each event that replaces earlier ones, if the viewer has not received it yet."""
        fresh = {event: text for event, text in latest.items() if viewer.sent_latest.get(event) != text}
        viewer.sent_latest |= fresh
        return "".join(_format_event(event, text) for event, text in fresh.items())

    def _make_beat(self, viewer: Viewer) -> str:
        return _format_event("beat", encode_json({"now": round(self._wall(), 3), "skipped": viewer.skipped}))

    def _encode_latest(self) -> dict[str, str]:
        encoded = {
            event: self._call_logged(event, partial(_encode, source)) for event, source in self._latest_sources.items()
        }
        return {event: text for event, text in encoded.items() if text is not None}

    def _call_logged(self, event: str, produce: Callable[[], Any]) -> Any:
        """Call ``produce`` and return its result, or None if it fails; consecutive failures are logged once."""
        try:
            found = produce()
        except Exception:
            # A store that cannot be read for a moment must not end the streams.
            if not self._failing.get(event):
                self._log.failure("cannot read the page's {event}; the streams continue without it", event=event)
            self._failing[event] = True
            return None
        self._failing[event] = False
        return found

    def _close(self, viewer: Viewer) -> None:
        self._viewers.remove(viewer)
        if not self._viewers:
            self._schedule(IDLE_S if self._is_open else None)


def _encode(source: Callable[[], Any]) -> str:
    return encode_json(source())


def _format_event(event: str, text: str) -> str:
    return f"event: {event}\ndata: {text}\n\n"


def read_token(request: Request) -> str:
    """Return the token or ticket of a request."""
    tickets: list[bytes] = (request.args or {}).get(b"ticket", [b""])
    return choose_token(request.getHeader("authorization") or "", tickets[0].decode("ascii", "replace"))


class CameraImages(JsonResource):
    """``/shot/<device>?after=N&viewer=V``: the newest picture, as soon as its number is not N.

    The response has the number in ``X-Seq``, to be used as the next ``after``; it is 204 after five seconds without a
    new picture.  A second request of the same viewer ends its first with 204, so one picture is in flight per viewer.
    """

    def __init__(self, stream_camera: StreamCamera, clock: IReactorTime) -> None:
        super().__init__()
        self._stream_camera = stream_camera
        self._clock = clock
        self._cameras: dict[str, CameraStream] = {}

    @property
    def watched(self) -> list[str]:
        """The devices with an open camera stream."""
        return list(self._cameras)

    def getChild(self, path: bytes, request: Request) -> Resource:
        """Return the resource of one device's camera."""
        return _CameraImage(self, path.decode("ascii", "replace"))

    def serve(self, uuid: str, request: Request) -> int | bytes:
        """Answer immediately if the newest picture is new to the viewer, otherwise with the next picture."""
        camera = self._cameras.get(uuid)
        if camera is None:
            try:
                camera = CameraStream(
                    self._clock, lambda on_frame: self._stream_camera(uuid, on_frame), lambda: self._end(uuid)
                )
            except Refusal as refusal:
                return write_refusal(request, refusal)
            self._cameras[uuid] = camera
        if len(camera.waiting) >= MAX_WAITING:
            return write_refusal(
                request, Refusal("shot", "there are too many viewers of this camera", "close a page and try again", 503)
            )
        camera.wait(request)
        return NOT_DONE_YET

    def close(self) -> None:
        """End every request and every upstream."""
        for camera in list(self._cameras.values()):
            camera.close()

    def _end(self, uuid: str) -> None:
        self._cameras.pop(uuid, None)


class _CameraImage(JsonResource):
    isLeaf = True

    def __init__(self, images: CameraImages, uuid: str) -> None:
        super().__init__()
        self._images = images
        self._uuid = uuid

    def render_GET(self, request: Request) -> int | bytes:
        return self._images.serve(self._uuid, request)
