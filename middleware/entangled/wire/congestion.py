"""Estimate round trips and loss of a path, and control the sending rate."""

from __future__ import annotations

import math

INITIAL_TIMEOUT_S = 0.1
MIN_TIMEOUT_S = 0.05
# On a path without jitter the deviation converges to zero; this minimum keeps the timeout longer than the round trip.
MIN_DEVIATION_S = 0.01
MIN_LATENESS_S = 0.002
MAX_TIMEOUT_S = 1.0
BACKOFF_FACTOR = 1.5
INITIAL_WINDOW = 10.0  # RFC 6928
MIN_WINDOW = 4.0
MAX_WINDOW = 512.0
BASE_ROUND_TRIP_S = 10.0
MIN_LOSS_SAMPLES = 32
ROUND_SAMPLES = 8
FIRST_GAIN, GAIN = 1 / 16, 1 / 128
"""The weight of the first datagram (as if 15 datagrams had arrived before), and of each datagram after the first
hundred."""
MAX_GAP_LOSSES = 4
"""The maximum number of losses that are counted for one gap in the datagram numbers.

After a partition or a suspension of the peer, the numbers in one session may have a gap of hundreds.
"""
MIN_LOSS = 0.01
"""Loss rates below this value are treated as zero, because the usual number of tries is sufficient for them."""
TOLERATED_FAILURES = 1e-4
"""The tolerated rate of failed exchanges between two nodes that both run."""
MAX_TRIES_AT_LOSS = 12


class RoundTrip:
    """The measured round trips of one peer, in seconds; ``timeout`` is the timeout of the next first try.

    After Jacobson (1988) and RFC 6298, with shorter bounds: smoothed time plus four deviations. The time of an answer
    after more than one try is not measured (Karn's algorithm); it only keeps the timeout longer until a first try is
    answered again.
    """

    __slots__ = ("timeout", "is_measured", "_smoothed", "_deviation", "_min_timeout")

    def __init__(self, initial_timeout: float = INITIAL_TIMEOUT_S, min_timeout: float = MIN_TIMEOUT_S) -> None:
        self.timeout = initial_timeout
        self.is_measured = False
        self._smoothed = 0.0
        self._deviation = 0.0
        self._min_timeout = min_timeout

    def add_sample(self, seconds: float) -> None:
        """Update the estimate with the round trip of a first try."""
        if self.is_measured:
            self._deviation += (abs(seconds - self._smoothed) - self._deviation) / 4
            self._smoothed += (seconds - self._smoothed) / 8
        else:
            self._smoothed, self._deviation = seconds, seconds / 2
            self.is_measured = True
        self.timeout = min(
            MAX_TIMEOUT_S, max(self._min_timeout, self._smoothed + max(MIN_DEVIATION_S, 4 * self._deviation))
        )

    @property
    def mean(self) -> float | None:
        """The smoothed round trip in seconds, or None before the first measurement."""
        return self._smoothed if self.is_measured else None

    @property
    def most(self) -> float | None:
        """The time in seconds within which most answers arrive, or None before the first measurement."""
        return self._smoothed + max(MIN_LATENESS_S, 2 * self._deviation) if self.is_measured else None

    @property
    def nearly_all(self) -> float:
        """The time in seconds within which nearly all answers arrive; initially the initial timeout."""
        if not self.is_measured:
            return self.timeout
        return max(self._smoothed * 9 / 8, self._smoothed + max(MIN_LATENESS_S, 4 * self._deviation))

    def lengthen(self, seconds: float) -> None:
        """Lengthen the timeout after an answer to a retransmitted request, ``seconds`` after its first try.

        Before the first measurement, a large value of ``seconds`` may be due to a long path.
        """
        longer = self.timeout * BACKOFF_FACTOR
        self.timeout = min(MAX_TIMEOUT_S, longer if self.is_measured else max(longer, seconds))


class CongestionWindow:
    """The congestion window: the maximum number of unacknowledged fragments to one peer.

    It grows in slow start, then slowly, and decreases multiplicatively. Radio links lose datagrams without congestion,
    and halving the window at each loss would leave a window of five at 5 % loss. Therefore a loss counts as congestion
    only if a queue builds up, as in TCP Veno (Fu and Liew, 2003), or if more than one in six of at least
    ``MIN_LOSS_SAMPLES`` fragments is lost. A queue is detected as in HyStart (Ha and Rhee, 2008; RFC 9406): the minimum
    of ``ROUND_SAMPLES`` round trips exceeds the minimum of the last ``BASE_ROUND_TRIP_S`` seconds by more than an
    eighth of that minimum, more than 4 ms, and more than twice the usual difference between successive round trips. The
    last condition prevents jitter from being mistaken for a queue.
    """

    __slots__ = (
        "size",
        "_threshold",
        "_min_round_trip",
        "_min_measured_at",
        "_round_min",
        "_samples",
        "_last_round_trip",
        "_jitter",
        "_round_end",
        "_acknowledged",
        "_lost",
    )

    def __init__(self) -> None:
        self.size = INITIAL_WINDOW
        self._threshold = MAX_WINDOW
        self._min_round_trip = math.inf
        self._min_measured_at = -math.inf
        self._round_min = math.inf
        self._samples = 0
        self._last_round_trip = -1.0
        self._jitter = 0.0
        self._round_end = 0
        self._acknowledged = self._lost = 0

    def acknowledge(self, count: int, order: int, last_order: int, round_trip: float | None, now: float) -> None:
        """Process an acknowledgement of ``count`` fragments.

        ``order`` is the position of the newest acknowledged fragment in the order of sending, ``last_order`` that of
        the last sent fragment. ``round_trip`` is in seconds, None if it was not measured.
        """
        if round_trip is not None:
            self._round_min = min(self._round_min, round_trip)
            self._samples += 1
            if self._last_round_trip >= 0.0:
                self._jitter += (abs(round_trip - self._last_round_trip) - self._jitter) / 16
            self._last_round_trip = round_trip
            if round_trip <= self._min_round_trip or now - self._min_measured_at > BASE_ROUND_TRIP_S:
                self._min_round_trip, self._min_measured_at = round_trip, now
        self._acknowledged += count
        if self.size < self._threshold:
            self.size += count
        else:
            self.size += count * max(1 / self.size, 1 / 32)
        self.size = min(self.size, MAX_WINDOW)
        if order >= self._round_end and self._samples >= ROUND_SAMPLES:
            self._adjust_to_congestion()
            self._round_end = last_order + 1
            self._round_min = math.inf
            self._samples = 0

    def count_losses(self, count: int) -> None:
        """Count lost fragments."""
        self._lost += count

    def collapse(self) -> None:
        """Restart from the smallest window, because no receipt arrived for more than a round trip."""
        self._threshold = max(MIN_WINDOW, self.size / 2)
        self.size = MIN_WINDOW

    def shrink_after_idle(self) -> None:
        """Reduce the window to its initial size after the path was idle."""
        self.size = min(self.size, INITIAL_WINDOW)

    def _adjust_to_congestion(self) -> None:
        is_queueing = self._round_min > self._min_round_trip + max(0.004, self._min_round_trip / 8, 2 * self._jitter)
        is_known = self._lost + self._acknowledged >= MIN_LOSS_SAMPLES
        if (is_queueing and self._lost > 0) or (is_known and 6 * self._lost > self._lost + self._acknowledged):
            self.size = self._threshold = max(MIN_WINDOW, self.size / 2)
            is_known = True
        elif is_queueing:
            self._threshold = min(self._threshold, self.size)
        if is_known:
            self._acknowledged = self._lost = 0


class LossRate:
    """Measures the recent loss rate (``rate``) of the datagrams to this node.

    Each session numbers the datagrams that it sends, so a gap in the received numbers is a loss, as in the reports of
    RTP (RFC 3550, section 6.4.1). Unlike a count of retransmissions, this method does not mistake a slow answer for a
    lost datagram.
    """

    __slots__ = ("rate", "_gain")

    def __init__(self) -> None:
        self.rate = 0.0
        self._gain = FIRST_GAIN

    def record_arrival(self, ahead: int) -> None:
        """Update the rate with a received datagram.

        ``ahead`` is the difference between the counter of the datagram and the highest earlier counter in the session.
        If ``ahead`` is 0 or less, the datagram was reordered and has already been counted as lost.
        """
        for _ in range(1, min(ahead, MAX_GAP_LOSSES + 1)):
            self._add_sample(1.0)
        if ahead > 0:
            self._add_sample(0.0)
        else:
            self.rate = max(0.0, self.rate - self._gain)

    def _add_sample(self, lost: float) -> None:
        self._gain = max(GAIN, self._gain / (1 + self._gain))  # at first a plain mean, later a moving average
        self.rate += (lost - self.rate) * self._gain

    @property
    def tries(self) -> int:
        """The number of tries with which an exchange rarely fails, if the loss rate is equal in both directions."""
        if self.rate < MIN_LOSS:
            return 1
        failure_rate = 1 - (1 - self.rate) ** 2
        return min(MAX_TRIES_AT_LOSS, math.ceil(math.log(TOLERATED_FAILURES) / math.log(failure_rate)))
