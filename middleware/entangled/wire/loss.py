"""Loss: which share of the datagrams that others send gets lost, and how many tries an exchange takes after that.

Each session counts what it sends, so a gap in the counters of what arrives is what was lost, as in RTP's reports (RFC
3550, section 6.4.1).  Unlike the number of tries that answers took, it cannot mistake a slow answer for a lost one.
"""

from __future__ import annotations

import math

FIRST_GAIN, GAIN = 1 / 16, 1 / 128
"""The weight of the first datagram, as if 15 had arrived before, and of each from the hundredth on."""
MOST_AT_ONCE = 4
"""What a gap counts for at most: after a cut, or a frozen peer, one session tells of hundreds."""
LEAST = 0.01
"""Less is none: the usual tries are there for that."""
RARE = 1e-4
"""The share of exchanges that may fail though both sides live."""
MOST_TRIES = 12


class Loss:
    """``share`` is that of the datagrams sent to us, lately, that did not arrive."""

    __slots__ = ("share", "_gain")

    def __init__(self) -> None:
        self.share = 0.0
        self._gain = FIRST_GAIN

    def arrived(self, ahead: int) -> None:
        """Learn from a datagram whose counter is so far ahead of the newest one before it in its session.

        One that was overtaken (0 or less) had been counted as lost.
        """
        for _ in range(1, min(ahead, MOST_AT_ONCE + 1)):
            self._learn(1.0)
        if ahead > 0:
            self._learn(0.0)
        else:
            self.share = max(0.0, self.share - self._gain)

    def _learn(self, lost: float) -> None:
        self._gain = max(GAIN, self._gain / (1 + self._gain))  # the mean of all, and later of the last ones
        self.share += (lost - self.share) * self._gain

    @property
    def tries(self) -> int:
        """In how many tries an exchange fails but rarely, where as much is lost on the way there as on the way back."""
        if self.share < LEAST:
            return 1
        fails = 1 - (1 - self.share) ** 2
        return min(MOST_TRIES, math.ceil(math.log(RARE) / math.log(fails)))
