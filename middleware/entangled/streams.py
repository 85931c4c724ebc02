"""Stream camera frames in the node's encrypted sessions; a newer frame replaces older ones.

A viewer subscribes to a channel of a publisher and renews the subscription; the publisher sends each frame in a few
datagrams without acknowledgement.  Incomplete and late frames are dropped, so there is never a backlog.  A publisher
without viewers sends nothing.  A frame carries its age, so that a viewer need not know the publisher's clock.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from twisted.internet.interfaces import IDelayedCall, IReactorTime

from middleware.entangled.background import cancel
from middleware.entangled.contact import Contact
from middleware.entangled.errors import EntangledError, Refused
from middleware.entangled.wire.endpoint import Endpoint

PART_BYTES = 1100
MAX_PARTS = 64
MAX_VIEWERS = 64
SUBSCRIPTION_TTL_S = 3.0
RENEW_INTERVAL_S = 1.0
RESTART_AFTER_S = 1.0
"""After this number of seconds without a newer frame, a lower number is accepted, because the publisher has
restarted."""
MAX_CHANNEL_CHARS = 32

MAX_AGE_S = 600.0
OnFrame = Callable[[int, bytes, float], None]
"""Called with the frame's number, its bytes, and its age in seconds."""


@dataclass
class _IncomingFrame:
    """The parts of a channel's newest frame.

    The first part came at ``arrived_at``, when the frame's age was ``age_s``.
    """

    sequence: int = -1
    count: int = 0
    arrived_at: float = 0.0
    age_s: float = 0.0
    parts: dict[int, bytes] = field(default_factory=dict)
    is_done: bool = False

    def add(self, sequence: int, number: int, count: int, part: bytes, age: float, now: float) -> bytes | None:
        """Add one part; return the frame if it is complete."""
        if sequence < self.sequence and now - self.arrived_at <= RESTART_AFTER_S:
            return None
        if sequence != self.sequence or count != self.count:
            self.sequence, self.count, self.parts, self.is_done = sequence, count, {}, False
            self.arrived_at, self.age_s = now, age
        self.parts[number] = part
        if self.is_done or len(self.parts) < count:
            return None
        self.is_done = True
        return b"".join(self.parts[n] for n in range(count))


class Streams:
    """The published and viewed channels of one node."""

    def __init__(self, endpoint: Endpoint, clock: IReactorTime) -> None:
        self._endpoint = endpoint
        self._clock = clock
        self._viewers: dict[str, dict[bytes, tuple[Contact, float]]] = {}
        self._views: dict[tuple[bytes, str], _View] = {}
        endpoint.expose("stream.open", self._answer_open, changes=True, idempotent=True)
        endpoint.expose("stream.part", self._answer_part)

    # -- publisher --------------------------------------------------------------------------------------------------

    def has_viewers(self, channel: str) -> bool:
        """Return whether ``channel`` has viewers now."""
        now = self._clock.seconds()
        viewers = self._viewers.get(channel, {})
        for node_id in [n for n, (_, until) in viewers.items() if until < now]:
            del viewers[node_id]
        if not viewers:
            self._viewers.pop(channel, None)
        return bool(viewers)

    def publish(self, channel: str, sequence: int, frame: bytes, age: float = 0.0) -> None:
        """Send ``frame``, taken ``age`` seconds ago, to the viewers of ``channel``.

        Frames of more than ``MAX_PARTS`` parts are not sent.
        """
        if not self.has_viewers(channel):
            return
        parts = [frame[i : i + PART_BYTES] for i in range(0, len(frame), PART_BYTES)]
        if len(parts) > MAX_PARTS:
            return
        age_ms = round(1000 * min(max(age, 0.0), MAX_AGE_S))
        for viewer, _ in self._viewers[channel].values():
            for number, part in enumerate(parts):
                self._endpoint.notify(viewer, "stream.part", channel, sequence, number, len(parts), part, age_ms)

    def _answer_open(self, peer: Contact, channel: str) -> bool:
        if len(channel) > MAX_CHANNEL_CHARS:
            raise Refused(f"the name of the channel must have at most {MAX_CHANNEL_CHARS} characters")
        for other in list(self._viewers):
            self.has_viewers(other)  # deletes expired viewers
        viewers = self._viewers.get(channel, {})
        if peer.node_id not in viewers and sum(map(len, self._viewers.values())) >= MAX_VIEWERS:
            raise Refused("this node has too many viewers; try again later")
        viewers[peer.node_id] = (peer, self._clock.seconds() + SUBSCRIPTION_TTL_S)
        self._viewers[channel] = viewers
        return True

    # -- viewer -----------------------------------------------------------------------------------------------------

    def view(self, publisher: Contact, channel: str, on_frame: OnFrame) -> Callable[[], None]:
        """Call ``on_frame(sequence, frame, age)`` for each complete new frame; return a function that stops it.

        ``age`` is the time in seconds since the frame was taken: its age at the publisher plus half a measured round
        trip.
        """
        place = (publisher.node_id, channel)
        look = self._views.get(place)
        if look is None:
            look = self._views[place] = _View(self, publisher, channel)
            look.renew()
        look.listeners.append(on_frame)

        def stop() -> None:
            if on_frame in look.listeners:
                look.listeners.remove(on_frame)
            if not look.listeners and self._views.get(place) is look:
                look.stop()
                del self._views[place]

        return stop

    def stop(self) -> None:
        """Stop all channels, viewed and published."""
        for look in self._views.values():
            look.stop()
        self._views.clear()
        self._viewers.clear()

    def _answer_part(
        self, peer: Contact, channel: str, sequence: int, number: int, count: int, part: bytes, age_ms: int = 0
    ) -> None:
        look = self._views.get((peer.node_id, channel))
        if look is None or not 0 <= number < count <= MAX_PARTS or len(part) > PART_BYTES:
            return
        if not 0 <= age_ms <= 1000 * MAX_AGE_S:
            return
        now, assembly = self._clock.seconds(), look.frame
        frame = assembly.add(sequence, number, count, part, age_ms / 1000, now)
        if frame is not None:
            age = assembly.age_s + now - assembly.arrived_at + (self._endpoint.round_trip(peer) or 0.0) / 2
            for on_frame in list(look.listeners):
                on_frame(sequence, frame, age)


class _View:
    """One viewed channel; its subscription is renewed as long as a listener views it."""

    def __init__(self, streams: Streams, publisher: Contact, channel: str) -> None:
        self.listeners: list[OnFrame] = []
        self.frame = _IncomingFrame()
        self._streams = streams
        self._publisher = publisher
        self._channel = channel
        self._timer: IDelayedCall | None = None

    def renew(self) -> None:
        """Renew the subscription."""
        self._timer = self._streams._clock.callLater(RENEW_INTERVAL_S, self.renew)
        opened = self._streams._endpoint.ask(self._publisher, "stream.open", self._channel, changes=True)
        opened.addErrback(lambda failure: failure.trap(EntangledError))

    def stop(self) -> None:
        """Stop renewing; the subscription expires at the publisher."""
        cancel(self._timer)
