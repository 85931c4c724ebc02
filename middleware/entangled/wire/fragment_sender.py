"""Send the messages to one peer in fragments, under congestion control and with retransmission of lost fragments."""

from __future__ import annotations

from collections import OrderedDict, deque
from collections.abc import Callable
from itertools import islice

from twisted.internet.interfaces import IDelayedCall, IReactorTime

from middleware.entangled.background import cancel
from middleware.entangled.wire.congestion import BACKOFF_FACTOR, MAX_TIMEOUT_S, CongestionWindow, RoundTrip
from middleware.entangled.wire.message import (
    FRAGMENT_BYTES,
    IS_ANSWER,
    MAX_FRAGMENTS,
    PART,
    WANTS_RECEIPT,
    MessageKey,
    Receipt,
    count_fragments,
)

IDLE_TIMEOUT_S = 10.0
MAX_PARALLEL_MESSAGES = 4  # messages to one peer that are sent alternately; more wait, to limit the receiver's memory
RECEIPT_EVERY = 4
REORDERING_THRESHOLD = 3
"""After a round trip, a fragment is lost if one sent this many places later has arrived (RFC 9002, 6.1.1)."""
MIN_TIMEOUT_S = 0.02
PROBE_FRAGMENTS = 2
MAX_PROBE_TIMEOUT_S = 0.25
IDLE_RESTART_S = 1.0


class FragmentedMessage:
    """An outgoing message, until every fragment is acknowledged.

    ``progress_at`` is the time of the last newly acknowledged fragment.
    """

    __slots__ = (
        "key",
        "data",
        "count",
        "acknowledged",
        "progress_at",
        "window_end",
        "send_orders",
        "retransmitted",
        "_sent",
        "_next",
        "_lost_fragments",
        "_header",
    )

    def __init__(self, key: MessageKey, data: bytes, now: float) -> None:
        self.key = key
        self.data = data
        self.count = count_fragments(len(data))
        self.acknowledged = 0  # bit n: fragment n is acknowledged
        self.window_end = MAX_FRAGMENTS
        self.progress_at = now
        self.send_orders: dict[int, int] = {}  # the position of each unacknowledged fragment in the order of sending
        self.retransmitted = 0  # bit n: fragment n was sent more than once, so its round trip is not measured (Karn)
        self._sent = 0
        self._next = 0
        self._lost_fragments: deque[int] = deque()
        self._header = key.id.to_bytes(8, "little") + len(data).to_bytes(4, "little")

    @property
    def is_done(self) -> bool:
        """Whether every fragment is acknowledged."""
        return self.acknowledged == (1 << self.count) - 1

    def next_fragment(self, limit: int | None = None) -> int | None:
        """Return the next fragment to send, lost ones first; None if all were sent or the receiver's buffer is full."""
        acknowledged, most = self.acknowledged, self.window_end if limit is None else limit
        while self._lost_fragments and acknowledged >> self._lost_fragments[0] & 1:
            self._lost_fragments.popleft()
        while self._next < self.count and acknowledged >> self._next & 1:
            self._next += 1
        number = self._lost_fragments[0] if self._lost_fragments else self._next
        return number if number < min(self.count, most) else None

    def mark_sent(self, number: int, order: int) -> None:
        """Record that fragment ``number`` was sent, at the position ``order`` in the order of sending."""
        if self._lost_fragments and self._lost_fragments[0] == number:
            self._lost_fragments.popleft()
        else:
            self._next = number + 1
        self.send_orders[number] = order

    def mark_lost(self, number: int) -> None:
        """Schedule a lost fragment for retransmission."""
        self.send_orders.pop(number, None)
        self.retransmitted |= 1 << number
        self._lost_fragments.append(number)

    def restart(self) -> None:
        """Send the message again from the start, because the receiver may have lost its fragments.

        If the receiver still has them, its first receipt lists them.
        """
        self.retransmitted |= (1 << self._next) - 1
        self.acknowledged, self._next, self.window_end = 0, 0, MAX_FRAGMENTS
        self._lost_fragments.clear()
        self.send_orders.clear()

    def requests_receipt(self) -> bool:
        """Return whether the fragment that is sent now requests a receipt: every fourth one does."""
        self._sent += 1
        return self._sent % RECEIPT_EVERY == 0

    def make_fragment(self, number: int, is_wanted: bool) -> bytes:
        """Return the PART with that number."""
        flags = self.key.is_answer * IS_ANSWER | is_wanted * WANTS_RECEIPT
        head = bytes([PART, flags]) + self._header + number.to_bytes(2, "little")
        return head + self.data[number * FRAGMENT_BYTES : (number + 1) * FRAGMENT_BYTES]

    def process_receipt(self, receipt: Receipt, now: float) -> list[int]:
        """Return the fragments that a receipt acknowledges for the first time."""
        self.window_end = receipt.next + receipt.room
        new = receipt.received & ((1 << self.count) - 1) & ~self.acknowledged
        self.acknowledged |= new
        numbers = []
        while new:
            lowest = new & -new
            numbers.append(lowest.bit_length() - 1)
            new ^= lowest
        if numbers:
            self.progress_at = now
        return numbers


class Flow:
    """Sends the fragmented messages to one peer; ``send_sealed`` encrypts bytes for the peer and sends them.

    An unacknowledged fragment is retransmitted when later fragments have been acknowledged, or when no receipt arrived
    for a smoothed round trip plus four deviations (``first_wait`` seconds before the first measurement).
    """

    def __init__(
        self,
        clock: IReactorTime,
        send_sealed: Callable[[bytes], None],
        on_ended: Callable[[FragmentedMessage], None],
        first_wait: float,
    ) -> None:
        self.messages: OrderedDict[MessageKey, FragmentedMessage] = OrderedDict()
        self._clock = clock
        self._send_sealed = send_sealed
        self._on_ended = on_ended
        self._window = CongestionWindow()
        self._round_trip = RoundTrip(first_wait, MIN_TIMEOUT_S)
        self._rotation: deque[FragmentedMessage] = deque()
        self._in_flight: dict[int, tuple[FragmentedMessage, int, float]] = {}  # in the order of sending
        self._order = 0
        self._newest_acknowledged = -1
        self._silent_probes = 0
        self.progress_reported_at = -1.0
        self._sent_at = 0.0
        self._timer: IDelayedCall | None = None

    def stop(self) -> None:
        """Cancel the timer."""
        cancel(self._timer)

    def send(self, key: MessageKey, message: bytes) -> None:
        """Send a message."""
        now = self._clock.seconds()
        if now - self._sent_at > IDLE_RESTART_S:
            self._window.shrink_after_idle()
        self.messages[key] = FragmentedMessage(key, message, now)
        self._send_fragments(now)

    def drop(self, key: MessageKey) -> None:
        """Stop sending a message."""
        message = self.messages.get(key)
        if message is not None:
            self._end(message)
            self._send_fragments(self._clock.seconds())

    def restart(self) -> None:
        """Restart every message, because the peer may have lost its fragments."""
        self._in_flight.clear()
        for message in self.messages.values():
            message.restart()
        self._send_fragments(self._clock.seconds())

    def process_receipt(self, receipt: Receipt) -> None:
        """Process a receipt."""
        message = self.messages.get(receipt.key)
        if message is None:
            return  # a late receipt
        now = self._clock.seconds()
        self._silent_probes = 0
        count, newest, round_trip = 0, -1, None
        for number in message.process_receipt(receipt, now):
            order = message.send_orders.pop(number, -1)
            if order < 0:
                self._window.count_losses(-1)  # the fragment was considered lost, but it arrived
                continue
            _, _, sent_at = self._in_flight.pop(order)
            count += 1
            newest = max(newest, order)
            if number == receipt.cause and not message.retransmitted >> number & 1:
                round_trip = now - sent_at
        if round_trip is not None:
            self._round_trip.add_sample(round_trip)
        if count:
            self._newest_acknowledged = max(self._newest_acknowledged, newest)
            self._window.acknowledge(count, newest, self._order, round_trip, now)
        if receipt.is_done or message.is_done:
            self._end(message)
        elif not receipt.room:
            self._mark_lost([order for order, (owner, _, _) in self._in_flight.items() if owner is message])
        self._detect_losses(now)
        self._send_fragments(now)

    def _detect_losses(self, now: float) -> None:
        lost = []
        latest = now - self._round_trip.nearly_all
        for order, (_, _, sent_at) in self._in_flight.items():
            if order > self._newest_acknowledged - REORDERING_THRESHOLD or sent_at > latest:
                break
            lost.append(order)
        self._mark_lost(lost)
        self._window.count_losses(len(lost))

    def _mark_lost(self, orders: list[int]) -> None:
        for order in orders:
            message, number, _ = self._in_flight.pop(order)
            message.mark_lost(number)

    def _send_fragments(self, now: float) -> None:
        """Send the fragments that the window allows, and set the timer."""
        picked: list[tuple[FragmentedMessage, int]] = []
        free = int(self._window.size) - len(self._in_flight)
        while len(picked) < free:
            message, number = self._pick_next()
            if message is None:
                break
            self._mark_sent(message, number, now)
            picked.append((message, number))
        # Each message requests receipts: for its last fragment in this burst, and for every fourth fragment.
        last = {message.key: place for place, (message, _) in enumerate(picked)}
        for place, (message, number) in enumerate(picked):
            self._send_sealed(message.make_fragment(number, message.requests_receipt() or place == last[message.key]))
        self._set_timer(now)

    def _pick_next(self) -> tuple[FragmentedMessage | None, int]:
        """Return the next message in turn and its fragment to send."""
        turns = self._rotation
        self._fill_rotation()
        for _ in range(len(turns)):
            message = turns[0]
            turns.rotate(-1)
            number = message.next_fragment()
            if number is not None:
                return message, number
        return None, 0

    def _fill_rotation(self) -> None:
        turns = self._rotation
        if len(turns) < MAX_PARALLEL_MESSAGES and len(turns) < len(self.messages):
            others = (one for one in self.messages.values() if one not in turns)
            turns.extend(islice(others, MAX_PARALLEL_MESSAGES - len(turns)))

    def _mark_sent(self, message: FragmentedMessage, number: int, now: float) -> None:
        message.mark_sent(number, self._order)
        self._in_flight[self._order] = (message, number, now)
        self._order += 1
        self._sent_at = now

    def _due_at(self) -> float:
        """Return the time of the next action if no receipt arrives until then."""
        if not self._in_flight:
            return self._sent_at + min(MAX_PROBE_TIMEOUT_S, self._probe_timeout())
        order, (_, _, sent_at) = next(iter(self._in_flight.items()))
        if order <= self._newest_acknowledged - REORDERING_THRESHOLD:
            return sent_at + self._round_trip.nearly_all
        return self._sent_at + self._probe_timeout()

    def _probe_timeout(self) -> float:
        wait = self._round_trip.timeout
        return min(
            MAX_TIMEOUT_S, max(wait, min(MAX_PROBE_TIMEOUT_S, wait * BACKOFF_FACTOR ** min(self._silent_probes, 8)))
        )

    def _set_timer(self, now: float) -> None:
        if not self.messages:
            cancel(self._timer)
            return
        at = max(now, self._due_at())
        if self._timer is not None and self._timer.active():
            if self._timer.getTime() <= at:
                return  # the timer function checks the time again: cheaper than a reset at every receipt
            self._timer.cancel()
        self._timer = self._clock.callLater(at - now, self._on_timer)

    def _on_timer(self) -> None:
        now = self._clock.seconds()
        for message in list(self.messages.values()):
            if now - message.progress_at >= IDLE_TIMEOUT_S:
                self._end(message)
        if self.messages and now >= self._due_at():
            before = len(self._in_flight)
            self._detect_losses(now)
            if len(self._in_flight) == before:
                self._probe(now)
        self._send_fragments(now)

    def _probe(self, now: float) -> None:
        """Send fragments as probes after a long silence, even if the congestion window or the receiver is full.

        From the third probe on, restart from the smallest congestion window.
        """
        self._silent_probes += 1
        if self._silent_probes > 2:
            self._window.collapse()
            self._mark_lost(list(self._in_flight))
        elif self._in_flight:
            self._mark_lost(list(self._in_flight)[:PROBE_FRAGMENTS])
        self._fill_rotation()
        message = self._rotation[0]
        self._rotation.rotate(-1)
        for _ in range(PROBE_FRAGMENTS):
            number = message.next_fragment(message.count)
            if number is None:
                break
            self._mark_sent(message, number, now)
            self._send_sealed(message.make_fragment(number, True))

    def _end(self, message: FragmentedMessage) -> None:
        del self.messages[message.key]
        for order in message.send_orders.values():
            del self._in_flight[order]
        if message in self._rotation:
            self._rotation.remove(message)
        self._on_ended(message)
