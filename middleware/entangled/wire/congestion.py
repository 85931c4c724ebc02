"""Estimate round trips and loss of a path, and control the sending rate."""

from __future__ import annotations

import math

FIRST_GUESS = 0.1
SHORTEST = 0.05
# On a path without jitter the deviation converges to zero; this minimum keeps the timeout longer than the round trip.
GRAIN = 0.01
LATE = 0.002
LONGEST = 1.0
BACK_OFF = 1.5
FIRST_WINDOW = 10.0  # RFC 6928
LEAST_WINDOW = 4.0
MOST_WINDOW = 512.0
BASE_S = 10.0
SAMPLE = 32
ROUND_SAMPLES = 8
FIRST_GAIN, GAIN = 1 / 16, 1 / 128
"""The weight of the first datagram, as if 15 had arrived before it, and of each one after the first hundred."""
MOST_AT_ONCE = 4
"""The most losses that one gap counts for: after a partition or a suspended peer, one session shows a gap of hundreds.
"""
LEAST = 0.01
"""Smaller loss rates count as zero: the usual number of tries covers them."""
RARE = 1e-4
"""The tolerated rate of exchanges that fail although both sides are alive."""
MOST_TRIES = 12


class RoundTrip:
    """The measured round trips of one peer, in seconds; ``wait`` is the timeout of the next first try.

    After Jacobson (1988) and RFC 6298, with shorter bounds: smoothed time plus four deviations. An answer after more
    than one try is not measured (Karn's algorithm); it only keeps the longer timeout until a first try is answered
    again.
    """

    __slots__ = ("wait", "is_measured", "_smoothed", "_deviation", "_shortest")

    def __init__(self, first: float = FIRST_GUESS, shortest: float = SHORTEST) -> None:
        self.wait = first
        self.is_measured = False
        self._smoothed = 0.0
        self._deviation = 0.0
        self._shortest = shortest

    def measured(self, seconds: float) -> None:
        """Update the estimate with the round trip of a first try."""
        if self.is_measured:
            self._deviation += (abs(seconds - self._smoothed) - self._deviation) / 4
            self._smoothed += (seconds - self._smoothed) / 8
        else:
            self._smoothed, self._deviation = seconds, seconds / 2
            self.is_measured = True
        self.wait = min(LONGEST, max(self._shortest, self._smoothed + max(GRAIN, 4 * self._deviation)))

    @property
    def mean(self) -> float | None:
        """The smoothed round trip in seconds, or None before the first measurement."""
        return self._smoothed if self.is_measured else None

    @property
    def likely(self) -> float | None:
        """The time in seconds within which most answers arrive, or None before the first measurement."""
        return self._smoothed + max(LATE, 2 * self._deviation) if self.is_measured else None

    @property
    def usual(self) -> float:
        """The time in seconds within which nearly all answers arrive; at first the initial timeout."""
        if not self.is_measured:
            return self.wait
        return max(self._smoothed * 9 / 8, self._smoothed + max(LATE, 4 * self._deviation))

    def ambiguous(self, seconds: float) -> None:
        """Lengthen the timeout after an answer to a retransmitted request, ``seconds`` after its first try.

        Before the first measurement ``seconds`` may be the length of the path.
        """
        longer = self.wait * BACK_OFF
        self.wait = min(LONGEST, longer if self.is_measured else max(longer, seconds))


class Window:
    """The congestion window: the number of fragments that may be under way to one peer.

    It grows in slow start, then slowly, and decreases multiplicatively. Radio links lose datagrams without congestion,
    and halving the window at each loss would leave a window of five at 5 % loss. Therefore a loss counts as congestion
    only if a queue builds up, as in TCP Veno (Fu and Liew, 2003), or if more than one in six of at least ``SAMPLE``
    fragments is lost. A queue is detected as in HyStart (Ha and Rhee, 2008; RFC 9406): the minimum of ``ROUND_SAMPLES``
    round trips exceeds the minimum of the last ``BASE_S`` seconds by an eighth of it, by 4 ms, and by twice the usual
    difference between successive round trips, because jitter is not a queue.
    """

    __slots__ = (
        "size",
        "_threshold",
        "_base",
        "_base_at",
        "_quickest",
        "_samples",
        "_last",
        "_jitter",
        "_round_end",
        "_taken",
        "_lost",
    )

    def __init__(self) -> None:
        self.size = FIRST_WINDOW
        self._threshold = MOST_WINDOW
        self._base = math.inf
        self._base_at = -math.inf
        self._quickest = math.inf
        self._samples = 0
        self._last = -1.0
        self._jitter = 0.0
        self._round_end = 0
        self._taken = self._lost = 0

    def taken(self, count: int, order: int, last_order: int, round_trip: float | None, now: float) -> None:
        """Process an acknowledgement of ``count`` fragments; the newest was number ``order`` of ``last_order`` sent."""
        if round_trip is not None:
            self._quickest = min(self._quickest, round_trip)
            self._samples += 1
            if self._last >= 0.0:
                self._jitter += (abs(round_trip - self._last) - self._jitter) / 16
            self._last = round_trip
            if round_trip <= self._base or now - self._base_at > BASE_S:
                self._base, self._base_at = round_trip, now
        self._taken += count
        if self.size < self._threshold:
            self.size += count
        else:
            self.size += count * max(1 / self.size, 1 / 32)
        self.size = min(self.size, MOST_WINDOW)
        if order >= self._round_end and self._samples >= ROUND_SAMPLES:
            self._adjust_to_congestion()
            self._round_end = last_order + 1
            self._quickest = math.inf
            self._samples = 0

    def lost(self, count: int) -> None:
        """Count lost fragments."""
        self._lost += count

    def collapse(self) -> None:
        """Restart from the smallest window, after more than a round trip without any receipt."""
        self._threshold = max(LEAST_WINDOW, self.size / 2)
        self.size = LEAST_WINDOW

    def rested(self) -> None:
        """Reduce the window to its initial size after the path was idle."""
        self.size = min(self.size, FIRST_WINDOW)

    def _adjust_to_congestion(self) -> None:
        is_queueing = self._quickest > self._base + max(0.004, self._base / 8, 2 * self._jitter)
        is_known = self._lost + self._taken >= SAMPLE
        if (is_queueing and self._lost > 0) or (is_known and 6 * self._lost > self._lost + self._taken):
            self.size = self._threshold = max(LEAST_WINDOW, self.size / 2)
            is_known = True
        elif is_queueing:
            self._threshold = min(self._threshold, self.size)
        if is_known:
            self._taken = self._lost = 0


class Loss:
    """Measures the recent loss rate (``share``) of the datagrams to this node.

    Each session numbers the datagrams that it sends, so a gap in the received numbers is a loss, as in the reports of
    RTP (RFC 3550, section 6.4.1).  Unlike a count of retransmissions, it does not mistake a slow answer for a lost one.
    """

    __slots__ = ("share", "_gain")

    def __init__(self) -> None:
        self.share = 0.0
        self._gain = FIRST_GAIN

    def arrived(self, ahead: int) -> None:
        """Update the rate with a datagram, its counter being ``ahead`` of the newest one before it in its session.

        A reordered datagram (0 or less) was counted as lost before.
        """
        for _ in range(1, min(ahead, MOST_AT_ONCE + 1)):
            self._learn(1.0)
        if ahead > 0:
            self._learn(0.0)
        else:
            self.share = max(0.0, self.share - self._gain)

    def _learn(self, lost: float) -> None:
        self._gain = max(GAIN, self._gain / (1 + self._gain))  # the mean of all, and later a moving average
        self.share += (lost - self.share) * self._gain

    @property
    def tries(self) -> int:
        """The number of tries after which an exchange rarely fails, if both directions lose the same share."""
        if self.share < LEAST:
            return 1
        failure_rate = 1 - (1 - self.share) ** 2
        return min(MOST_TRIES, math.ceil(math.log(RARE) / math.log(failure_rate)))
