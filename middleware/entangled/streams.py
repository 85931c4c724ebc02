"""Streams: newest-frame-wins channels for cameras, over the node's own sealed port.

A viewer opens a channel at a publisher and keeps it open by asking again; the publisher sends each frame in a few
datagrams that nobody acknowledges.  A frame that misses a part is dropped, and a late one too: there is never a
backlog.  Nothing is sent while nobody looks.  A frame carries its age, so that a viewer knows how old it is without
knowing the publisher's clock.
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
OPEN_TTL = 3.0
RENEW = 1.0
PATIENCE = 1.0
"""Seconds without a newer frame after which an older number is believed: the publisher began anew."""
MAX_CHANNEL = 32

MAX_AGE = 600.0
OnFrame = Callable[[int, bytes, float], None]
"""Called with number, frame and age in seconds."""


@dataclass
class _Assembly:
    """The parts of the newest frame of one channel; ``at`` is when its first part came, ``age`` how old it was then."""

    sequence: int = -1
    count: int = 0
    at: float = 0.0
    age: float = 0.0
    parts: dict[int, bytes] = field(default_factory=dict)
    is_done: bool = False

    def add(self, sequence: int, number: int, count: int, part: bytes, age: float, now: float) -> bytes | None:
        """Take in one part; the whole frame where it was the last one missing."""
        if sequence < self.sequence and now - self.at <= PATIENCE:
            return None
        if sequence != self.sequence or count != self.count:
            self.sequence, self.count, self.parts, self.is_done = sequence, count, {}, False
            self.at, self.age = now, age
        self.parts[number] = part
        if self.is_done or len(self.parts) < count:
            return None
        self.is_done = True
        return b"".join(self.parts[n] for n in range(count))


class Streams:
    """Both sides of all channels of one node."""

    def __init__(self, endpoint: Endpoint, clock: IReactorTime) -> None:
        self._endpoint = endpoint
        self._clock = clock
        self._viewers: dict[str, dict[bytes, tuple[Contact, float]]] = {}
        self._looks: dict[tuple[bytes, str], _Look] = {}
        endpoint.expose("stream.open", self._answer_open, changes=True, idempotent=True)
        endpoint.expose("stream.part", self._answer_part)

    # -- publisher --------------------------------------------------------------------------------------------------

    def is_wanted(self, channel: str) -> bool:
        """Whether anybody looks at ``channel`` now."""
        now = self._clock.seconds()
        viewers = self._viewers.get(channel, {})
        for node_id in [n for n, (_, until) in viewers.items() if until < now]:
            del viewers[node_id]
        if not viewers:
            self._viewers.pop(channel, None)
        return bool(viewers)

    def offer(self, channel: str, sequence: int, frame: bytes, age: float = 0.0) -> None:
        """Send ``frame``, taken ``age`` seconds ago, to whoever looks at ``channel``.

        Frames of over ``MAX_PARTS`` parts are not sent.
        """
        if not self.is_wanted(channel):
            return
        parts = [frame[i : i + PART_BYTES] for i in range(0, len(frame), PART_BYTES)]
        if len(parts) > MAX_PARTS:
            return
        age_ms = round(1000 * min(max(age, 0.0), MAX_AGE))
        for viewer, _ in self._viewers[channel].values():
            for number, part in enumerate(parts):
                self._endpoint.tell(viewer, "stream.part", channel, sequence, number, len(parts), part, age_ms)

    def _answer_open(self, peer: Contact, channel: str) -> bool:
        if len(channel) > MAX_CHANNEL:
            raise Refused(f"a channel is named by at most {MAX_CHANNEL} characters")
        for other in list(self._viewers):
            self.is_wanted(other)  # forgets whoever looked no more
        viewers = self._viewers.get(channel, {})
        if peer.node_id not in viewers and sum(map(len, self._viewers.values())) >= MAX_VIEWERS:
            raise Refused("too many viewers")
        viewers[peer.node_id] = (peer, self._clock.seconds() + OPEN_TTL)
        self._viewers[channel] = viewers
        return True

    # -- viewer -----------------------------------------------------------------------------------------------------

    def look(self, publisher: Contact, channel: str, on_frame: OnFrame) -> Callable[[], None]:
        """Call ``on_frame(sequence, frame, age)`` at each whole new frame until what is returned is called.

        ``age`` is in seconds since it was taken: as the publisher says, and half a round trip, where one was measured.
        """
        place = (publisher.node_id, channel)
        look = self._looks.get(place)
        if look is None:
            look = self._looks[place] = _Look(self, publisher, channel)
            look.renew()
        look.watchers.append(on_frame)

        def stop() -> None:
            if on_frame in look.watchers:
                look.watchers.remove(on_frame)
            if not look.watchers and self._looks.get(place) is look:
                look.end()
                del self._looks[place]

        return stop

    def stop(self) -> None:
        """End everything that is looked at, and send nothing more."""
        for look in self._looks.values():
            look.end()
        self._looks.clear()
        self._viewers.clear()

    def _answer_part(
        self, peer: Contact, channel: str, sequence: int, number: int, count: int, part: bytes, age_ms: int = 0
    ) -> None:
        look = self._looks.get((peer.node_id, channel))
        if look is None or not 0 <= number < count <= MAX_PARTS or len(part) > PART_BYTES:
            return
        if not 0 <= age_ms <= 1000 * MAX_AGE:
            return
        now, assembly = self._clock.seconds(), look.assembly
        frame = assembly.add(sequence, number, count, part, age_ms / 1000, now)
        if frame is not None:
            age = assembly.age + now - assembly.at + (self._endpoint.round_trip(peer) or 0.0) / 2
            for on_frame in list(look.watchers):
                on_frame(sequence, frame, age)


class _Look:
    """One channel looked at, kept open while there is a watcher."""

    def __init__(self, streams: Streams, publisher: Contact, channel: str) -> None:
        self.watchers: list[OnFrame] = []
        self.assembly = _Assembly()
        self._streams = streams
        self._publisher = publisher
        self._channel = channel
        self._timer: IDelayedCall | None = None

    def renew(self) -> None:
        """Ask the publisher to go on."""
        self._timer = self._streams._clock.callLater(RENEW, self.renew)
        opened = self._streams._endpoint.ask(self._publisher, "stream.open", self._channel, changes=True)
        opened.addErrback(lambda failure: failure.trap(EntangledError))

    def end(self) -> None:
        """Stop renewing; the publisher notices by itself."""
        cancel(self._timer)
