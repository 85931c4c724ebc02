"""Link: how good the way to one peer is, from the times that it took to answer; pure.

Several small questions are asked one after the other.  One whose first datagram, or its answer, was lost is asked again
after a while, so that it takes much longer than the others: so losses are seen also where they are mended.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

RETRY = 0.045
"""Seconds that an answer to a second try comes later at least: the wire waits 50 ms for the first."""


@dataclass(frozen=True)
class Link:
    """The way to one peer: the share of questions that were lost at the first try, and seconds."""

    loss: float
    round_trip: float | None
    jitter: float | None
    is_relayed: bool

    @property
    def score(self) -> int:
        """0 (nothing comes back) to 100 (near, steady, direct).

        A tenth lost costs 30 points, 100 ms of round trip 10 (at most 25), 20 ms of jitter 8 (at most 15), a relay 15.
        """
        if self.round_trip is None or self.jitter is None:
            return 0
        late = min(25.0, max(0.0, self.round_trip - 0.005) * 100.0)
        shaky = min(15.0, max(0.0, self.jitter - 0.001) * 400.0)
        return max(1, round(100.0 - 300.0 * min(self.loss, 0.3) - late - shaky - 15.0 * self.is_relayed))


def link(times: Sequence[float | None], is_relayed: bool) -> Link:
    """The link whose questions took so many seconds, None for one that nobody answered."""
    answered = sorted(seconds for seconds in times if seconds is not None)
    if not answered:
        return Link(1.0, None, None, is_relayed)
    usual = median(answered[: (len(answered) + 1) // 2])
    first = [seconds for seconds in answered if seconds < usual * 1.5 + RETRY]
    middle = median(first)
    jitter = sum(abs(each - middle) for each in first) / len(first)
    return Link((len(times) - len(first)) / len(times), middle, jitter, is_relayed)


def median(times: Sequence[float]) -> float:
    """The middle one of some times, which stand in order."""
    half = len(times) // 2
    return times[half] if len(times) % 2 else (times[half - 1] + times[half]) / 2
