"""Decide what one direction of a link does to a frame.  Pure: time and random numbers are arguments."""

from __future__ import annotations

import math
from dataclasses import dataclass
from random import Random


@dataclass(frozen=True)
class Impairments:
    """The impairments of a link.

    ``loss``, ``dup``, ``reorder`` and ``corrupt`` are percentages; ``burst`` is the mean number of consecutive losses
    (1: independent losses); ``delay`` and ``jitter`` (a standard deviation) are milliseconds; ``rate`` is kbit/s
    (0: unlimited), with a queue of ``queue`` milliseconds; frames that would wait longer are lost.
    """

    loss: float = 0.0
    burst: float = 1.0
    dup: float = 0.0
    reorder: float = 0.0
    corrupt: float = 0.0
    delay: float = 0.0
    jitter: float = 0.0
    rate: float = 0.0
    queue: float = 500.0

    def __post_init__(self) -> None:
        for name in ("loss", "dup", "reorder", "corrupt"):
            if not 0.0 <= getattr(self, name) <= 100.0:
                raise ValueError(f"{name} must be a percentage from 0 to 100, not {getattr(self, name)!r}")
        for name in ("delay", "jitter", "rate", "queue"):
            if not 0.0 <= getattr(self, name) < math.inf:
                raise ValueError(f"{name} must be a number of at least 0, not {getattr(self, name)!r}")
        if not 1.0 <= self.burst < math.inf:
            raise ValueError(f"burst must be a number of frames of at least 1, not {self.burst!r}")

    @property
    def is_perfect(self) -> bool:
        """Whether the link has no impairments."""
        return not (self.loss or self.dup or self.reorder or self.corrupt or self.delay or self.jitter or self.rate)


class LinkDirection:
    """One direction of a link; ``passed`` and ``lost`` count frames, ``passed_bytes`` the bytes of passed frames."""

    def __init__(self, rng: Random) -> None:
        self.passed = self.lost = self.passed_bytes = 0
        self._rng = rng
        self._impairments = Impairments()
        self._is_in_burst = False
        self._free_at = 0.0

    @property
    def impairments(self) -> Impairments:
        """The current impairments of this direction."""
        return self._impairments

    @impairments.setter
    def impairments(self, value: Impairments) -> None:
        self._impairments, self._is_in_burst = value, False

    @property
    def counts(self) -> dict[str, int]:
        """The counters."""
        return {"passed": self.passed, "lost": self.lost, "bytes": self.passed_bytes}

    def draw_delivery_times(self, size: int, now: float) -> list[float]:
        """Return the delivery times of a frame of ``size`` bytes: none for a lost frame, two for a duplicated one."""
        impairments = self._impairments
        if impairments.is_perfect:
            self.passed += 1
            self.passed_bytes += size
            return [now]
        moment = now
        if self._is_lost():
            self.lost += 1
            return []
        if impairments.rate:
            begins = max(now, self._free_at)
            if begins - now > impairments.queue / 1000:
                self.lost += 1
                return []
            self._free_at = begins + size * 8 / (impairments.rate * 1000)
            moment = self._free_at
        # A reordered frame is not delayed, so it overtakes delayed frames.
        if not self._draw(impairments.reorder):
            spread = self._rng.gauss(0.0, impairments.jitter) if impairments.jitter else 0.0
            moment += max(0.0, impairments.delay + spread) / 1000
        self.passed += 1
        self.passed_bytes += size
        return [moment] * (2 if self._draw(impairments.dup) else 1)

    def corrupt_frame(self, frame: bytes, header: int) -> bytes:
        """Return ``frame``, with one flipped bit after its first ``header`` bytes if it is to be corrupted."""
        if len(frame) <= header or not self._draw(self._impairments.corrupt):
            return frame
        place = self._rng.randrange(header, len(frame))
        return frame[:place] + bytes([frame[place] ^ 1 << self._rng.randrange(8)]) + frame[place + 1 :]

    def _is_lost(self) -> bool:
        """Draw whether a frame is lost (Gilbert-Elliott: all frames are lost in the bad state, none otherwise)."""
        loss, burst = self._impairments.loss / 100, self._impairments.burst
        if burst <= 1.0 or not 0.0 < loss < 1.0:
            return self._draw(100 * loss)
        turns = 1 / burst if self._is_in_burst else min(1.0, loss / (1 - loss) / burst)
        if self._rng.random() < turns:
            self._is_in_burst = not self._is_in_burst
        return self._is_in_burst

    def _draw(self, percent: float) -> bool:
        return percent > 0.0 and self._rng.random() * 100 < percent
