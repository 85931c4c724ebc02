"""Session: one connection to the yard as the yard remembers it."""

from __future__ import annotations

from collections.abc import Callable

from drivers.link import Link
from drivers.sim.codec import FrameReader, Message, encoded


class Session:
    """A driver that holds ``robot``, or an operator, or somebody who has not said yet; a ``Receiver`` of the link."""

    def __init__(
        self, link: Link, on_message: Callable[[Session, Message], None], on_down: Callable[[Session], None], now: float
    ) -> None:
        self.link = link
        self.robot: str | None = None
        self.has_motors = False
        self.is_operator = False
        self.heard_at = now
        self.pictures = Beat(0.0)
        self.truths = Beat(0.0)
        self.reader = FrameReader()
        self.seq = 0
        self.dropped = 0
        self.is_down = False
        self._on_message = on_message
        self._on_down = on_down

    def send(self, message: Message) -> None:
        """Send one message, whole and at once."""
        self.link.send(encoded(message))

    def received(self, data: bytes) -> None:
        """Take bytes from the client."""
        for message in self.reader.read(data):
            if self.is_down:
                return
            self._on_message(self, message)

    def link_down(self) -> None:
        """Learn that the client is gone."""
        if not self.is_down:
            self.is_down = True
            self._on_down(self)


class Beat:
    """A rhythm of ``rate`` a second on the yard's time; 0 never beats."""

    def __init__(self, rate: float) -> None:
        self._period = 1.0 / rate if rate > 0 else 0.0
        self._next_at = 0.0

    @property
    def is_wanted(self) -> bool:
        """Whether it ever beats."""
        return self._period > 0.0

    def is_due(self, t: float) -> bool:
        """Whether a beat falls due at ``t``; asked once each tick, it keeps the rate on average."""
        # The tolerance keeps a beat that falls exactly on a tick from slipping to the next one by rounding.
        if not self.is_wanted or t < self._next_at - 1e-6:
            return False
        self._next_at += self._period
        if self._next_at < t:
            # The first beat, or one after a pause: what was missed is not made up for.
            self._next_at = t + self._period
        return True
