"""RoundTrip: how long to wait for a peer before trying again, learned from its answers.

After Jacobson (1988) and RFC 6298, with shorter bounds: smoothed time plus four deviations; an answer after more than
one try measures nothing (Karn), it only keeps the longer wait until a first try is answered again.
"""

from __future__ import annotations

FIRST_GUESS = 0.1
SHORTEST = 0.05
LONGEST = 1.0
BACK_OFF = 1.5


class RoundTrip:
    """The measured round trips of one peer, in seconds; ``wait`` is the time-out of the next first try."""

    __slots__ = ("wait", "is_measured", "_smoothed", "_deviation")

    def __init__(self) -> None:
        self.wait = FIRST_GUESS
        self.is_measured = False
        self._smoothed = 0.0
        self._deviation = 0.0

    def measured(self, seconds: float) -> None:
        """Learn from an answer to a first try."""
        if self.is_measured:
            self._deviation += (abs(seconds - self._smoothed) - self._deviation) / 4
            self._smoothed += (seconds - self._smoothed) / 8
        else:
            self._smoothed, self._deviation = seconds, seconds / 2
            self.is_measured = True
        self.wait = min(LONGEST, max(SHORTEST, self._smoothed + 4 * self._deviation))

    def ambiguous(self) -> None:
        """Learn from an answer to one of several tries: the wait was perhaps too short."""
        self.wait = min(LONGEST, self.wait * BACK_OFF)
