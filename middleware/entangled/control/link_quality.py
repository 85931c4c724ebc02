"""Quality of the path to one peer, computed from round-trip times; without I/O.

Several pings are sent one after the other.  If the first datagram of a ping or of its answer is lost, it is
retransmitted, and the ping takes much longer than other pings.  Losses can therefore be detected although
retransmission repairs them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

RETRANSMISSION_S = 0.045
"""The minimum additional seconds of a retransmitted ping; a request is retransmitted after at least 50 ms."""


@dataclass(frozen=True)
class LinkQuality:
    """The quality of a path: share of pings lost at the first attempt; round trip and jitter in seconds."""

    loss: float
    round_trip: float | None
    jitter: float | None
    is_relayed: bool

    @property
    def score(self) -> int:
        """A score from 0 (no answers) to 100 (no loss, short round trips without jitter, no relay).

        It is reduced by 30 points for 10 % loss, by 10 for 100 ms of round trip (at most 25), by 8 for 20 ms of jitter
        (at most 15), and by 15 for a relay.
        """
        if self.round_trip is None or self.jitter is None:
            return 0
        late = min(25.0, max(0.0, self.round_trip - 0.005) * 100.0)
        shaky = min(15.0, max(0.0, self.jitter - 0.001) * 400.0)
        return max(1, round(100.0 - 300.0 * min(self.loss, 0.3) - late - shaky - 15.0 * self.is_relayed))


def compute_quality(times: Sequence[float | None], is_relayed: bool) -> LinkQuality:
    """Return the quality of a path with these round-trip times in seconds, None for a ping without an answer."""
    answered = sorted(seconds for seconds in times if seconds is not None)
    if not answered:
        return LinkQuality(1.0, None, None, is_relayed)
    usual = median(answered[: (len(answered) + 1) // 2])
    first = [seconds for seconds in answered if seconds < usual * 1.5 + RETRANSMISSION_S]
    middle = median(first)
    jitter = sum(abs(each - middle) for each in first) / len(first)
    return LinkQuality((len(times) - len(first)) / len(times), middle, jitter, is_relayed)


def median(times: Sequence[float]) -> float:
    """Return the median of sorted times."""
    half = len(times) // 2
    return times[half] if len(times) % 2 else (times[half - 1] + times[half]) / 2
