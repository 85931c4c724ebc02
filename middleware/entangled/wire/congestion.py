"""Congestion: how fast a path may be used: how long an answer is waited for, how often and how much is sent."""

from __future__ import annotations

import math

FIRST_GUESS = 0.1
SHORTEST = 0.05
# On an even path the deviation goes to zero; without this the time-out would come together with the answer.
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
"""The weight of the first datagram, as if 15 had arrived before, and of each from the hundredth on."""
MOST_AT_ONCE = 4
"""What a gap counts for at most: after a cut, or a frozen peer, one session tells of hundreds."""
LEAST = 0.01
"""Less is none: the usual tries are there for that."""
RARE = 1e-4
"""The share of exchanges that may fail though both sides live."""
MOST_TRIES = 12


class RoundTrip:
    """The measured round trips of one peer, in seconds; ``wait`` is the time-out of the next first try.

    After Jacobson (1988) and RFC 6298, with shorter bounds: smoothed time plus four deviations; an answer after more
    than one try measures nothing (Karn), it only keeps the longer wait until a first try is answered again.
    """

    __slots__ = ("wait", "is_measured", "_smoothed", "_deviation", "_shortest")

    def __init__(self, first: float = FIRST_GUESS, shortest: float = SHORTEST) -> None:
        self.wait = first
        self.is_measured = False
        self._smoothed = 0.0
        self._deviation = 0.0
        self._shortest = shortest

    def measured(self, seconds: float) -> None:
        """Learn from an answer to a first try."""
        if self.is_measured:
            self._deviation += (abs(seconds - self._smoothed) - self._deviation) / 4
            self._smoothed += (seconds - self._smoothed) / 8
        else:
            self._smoothed, self._deviation = seconds, seconds / 2
            self.is_measured = True
        self.wait = min(LONGEST, max(self._shortest, self._smoothed + max(GRAIN, 4 * self._deviation)))

    @property
    def mean(self) -> float | None:
        """The smoothed round trip in seconds, or None where nothing was measured yet."""
        return self._smoothed if self.is_measured else None

    @property
    def likely(self) -> float | None:
        """Within how many seconds most answers come, or None where nothing was measured yet."""
        return self._smoothed + max(LATE, 2 * self._deviation) if self.is_measured else None

    @property
    def usual(self) -> float:
        """Within how many seconds nearly every answer comes; the first wait where nothing was measured yet."""
        if not self.is_measured:
            return self.wait
        return max(self._smoothed * 9 / 8, self._smoothed + max(LATE, 4 * self._deviation))

    def ambiguous(self, seconds: float) -> None:
        """Learn from an answer to one of several tries, so long after the first: the wait was perhaps too short.

        Where nothing is known, the way may be as long as that.
        """
        longer = self.wait * BACK_OFF
        self.wait = min(LONGEST, longer if self.is_measured else max(longer, seconds))


class Window:
    """How many parts may be under way to one peer: slow start, then slow increase and multiplicative decrease.

    Radio loses datagrams without being full, and halving the window at each of them would leave a window of five at 5 %
    loss.  So a loss counts as congestion only with a queue behind it, as in TCP Veno (Fu and Liew, 2003), or when more
    than one in six of at least ``SAMPLE`` parts is lost.  A queue is seen as in HyStart (Ha and Rhee, 2008; RFC 9406):
    even the quickest of ``ROUND_SAMPLES`` round trips takes longer than the quickest of the last ``BASE_S`` seconds by
    an eighth of that, by 4 ms, and by twice what round trips usually differ from one to the next: jitter is no queue.
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
        """Learn from a receipt for ``count`` parts, the newest being sent as number ``order`` of ``last_order``."""
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
            self._judge()
            self._round_end = last_order + 1
            self._quickest = math.inf
            self._samples = 0

    def lost(self, count: int) -> None:
        """Take note of parts that were lost."""
        self._lost += count

    def collapse(self) -> None:
        """Begin from little: a round trip and more has passed without any receipt."""
        self._threshold = max(LEAST_WINDOW, self.size / 2)
        self.size = LEAST_WINDOW

    def rested(self) -> None:
        """Forget what was learned of a path that has not been used for a while."""
        self.size = min(self.size, FIRST_WINDOW)

    def _judge(self) -> None:
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
    """``share`` is that of the datagrams sent to us, lately, that did not arrive.

    Each session counts what it sends, so a gap in the counters of what arrives is what was lost, as in RTP's reports
    (RFC 3550, section 6.4.1).  Unlike the number of tries that answers took, it cannot mistake a slow answer for a lost
    one.
    """

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
