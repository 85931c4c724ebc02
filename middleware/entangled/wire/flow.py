"""Send the messages to one peer in fragments, under congestion control and with retransmission of lost fragments."""

from __future__ import annotations

from collections import OrderedDict, deque
from collections.abc import Callable
from itertools import islice

from twisted.internet.interfaces import IDelayedCall, IReactorTime

from middleware.entangled.background import cancel
from middleware.entangled.wire.congestion import BACK_OFF, LONGEST, RoundTrip, Window
from middleware.entangled.wire.message import (
    MAX_PARTS,
    OF_ANSWER,
    PART,
    PART_BYTES,
    WANTED,
    Key,
    Receipt,
    part_count,
)

IDLE_S = 10.0
TURNS = 4  # messages to one peer that are sent in turn; the others wait, or each would occupy memory at the receiver
RECEIPT_EVERY = 4
GAP = 3  # a fragment is lost if one sent this much later has arrived (RFC 9002, 6.1.1), after a round trip
SHORTEST_WAIT = 0.02
PROBES = 2
LONGEST_PROBE = 0.25
REST_S = 1.0


class Parcel:
    """An outgoing message, until every fragment is acknowledged.

    ``progress_at`` is the time of the last newly acknowledged fragment.
    """

    __slots__ = (
        "key",
        "data",
        "count",
        "here",
        "progress_at",
        "room",
        "orders",
        "repeated",
        "_sent",
        "_next",
        "_lost_parts",
        "_head",
    )

    def __init__(self, key: Key, data: bytes, now: float) -> None:
        self.key = key
        self.data = data
        self.count = part_count(len(data))
        self.here = 0  # bit n: fragment n is acknowledged
        self.room = MAX_PARTS
        self.progress_at = now
        self.orders: dict[int, int] = {}  # of the fragments under way: the place in the order of sending
        self.repeated = 0  # bit n: fragment n was sent more than once, so its receipt is no measurement (Karn)
        self._sent = 0
        self._next = 0
        self._lost_parts: deque[int] = deque()
        self._head = key.id.to_bytes(8, "little") + len(data).to_bytes(4, "little")

    @property
    def is_done(self) -> bool:
        """Whether every fragment is acknowledged."""
        return self.here == (1 << self.count) - 1

    def due(self, limit: int | None = None) -> int | None:
        """Return the next fragment to send, lost ones first; None if all are under way or the receiver has no room."""
        here, most = self.here, self.room if limit is None else limit
        while self._lost_parts and here >> self._lost_parts[0] & 1:
            self._lost_parts.popleft()
        while self._next < self.count and here >> self._next & 1:
            self._next += 1
        number = self._lost_parts[0] if self._lost_parts else self._next
        return number if number < min(self.count, most) else None

    def sent(self, number: int, order: int) -> None:
        """Record that a due fragment was sent."""
        if self._lost_parts and self._lost_parts[0] == number:
            self._lost_parts.popleft()
        else:
            self._next = number + 1
        self.orders[number] = order

    def lost(self, number: int) -> None:
        """Schedule a lost fragment for retransmission."""
        self.orders.pop(number, None)
        self.repeated |= 1 << number
        self._lost_parts.append(number)

    def restart(self) -> None:
        """Restart, because the receiver may have lost its fragments; if it has not, its first receipt shows them."""
        self.repeated |= (1 << self._next) - 1
        self.here, self._next, self.room = 0, 0, MAX_PARTS
        self._lost_parts.clear()
        self.orders.clear()

    def is_turn(self) -> bool:
        """Return whether the fragment that is sent now requests a receipt: every fourth one does."""
        self._sent += 1
        return self._sent % RECEIPT_EVERY == 0

    def part(self, number: int, is_wanted: bool) -> bytes:
        """Return the PART with that number."""
        flags = self.key.is_answer * OF_ANSWER | is_wanted * WANTED
        head = bytes([PART, flags]) + self._head + number.to_bytes(2, "little")
        return head + self.data[number * PART_BYTES : (number + 1) * PART_BYTES]

    def taken(self, receipt: Receipt, now: float) -> list[int]:
        """Return the fragments that a receipt acknowledges for the first time."""
        self.room = receipt.next + receipt.room
        new = receipt.here & ((1 << self.count) - 1) & ~self.here
        self.here |= new
        numbers = []
        while new:
            lowest = new & -new
            numbers.append(lowest.bit_length() - 1)
            new ^= lowest
        if numbers:
            self.progress_at = now
        return numbers


class Flow:
    """The fragmented messages to one peer; ``send`` seals bytes for it.

    A fragment that is not acknowledged is retransmitted when later ones have arrived, or when nothing was received for
    a smoothed round trip plus four deviations (``first_wait`` before the first measurement).
    """

    def __init__(
        self, clock: IReactorTime, send: Callable[[bytes], None], ended: Callable[[Parcel], None], first_wait: float
    ) -> None:
        self.parcels: OrderedDict[Key, Parcel] = OrderedDict()
        self._clock = clock
        self._send = send
        self._ended = ended
        self._window = Window()
        self._round_trip = RoundTrip(first_wait, SHORTEST_WAIT)
        self._turns: deque[Parcel] = deque()
        self._under_way: dict[int, tuple[Parcel, int, float]] = {}  # in the order of sending
        self._order = 0
        self._newest_taken = -1
        self._silences = 0
        self.told_at = -1.0
        self._sent_at = 0.0
        self._timer: IDelayedCall | None = None

    def stop(self) -> None:
        """Cancel the timer."""
        cancel(self._timer)

    def post(self, key: Key, message: bytes) -> None:
        """Send a message."""
        now = self._clock.seconds()
        if now - self._sent_at > REST_S:
            self._window.rested()
        self.parcels[key] = Parcel(key, message, now)
        self._pump(now)

    def drop(self, key: Key) -> None:
        """Stop sending a message."""
        parcel = self.parcels.get(key)
        if parcel is not None:
            self._end(parcel)
            self._pump(self._clock.seconds())

    def restart(self) -> None:
        """Restart every message, because the peer may have lost its fragments."""
        self._under_way.clear()
        for parcel in self.parcels.values():
            parcel.restart()
        self._pump(self._clock.seconds())

    def take(self, receipt: Receipt) -> None:
        """Process a receipt."""
        parcel = self.parcels.get(receipt.key)
        if parcel is None:
            return  # a late receipt
        now = self._clock.seconds()
        self._silences = 0
        count, newest, round_trip = 0, -1, None
        for number in parcel.taken(receipt, now):
            order = parcel.orders.pop(number, -1)
            if order < 0:
                self._window.lost(-1)  # it was considered lost, and arrived after all
                continue
            _, _, sent_at = self._under_way.pop(order)
            count += 1
            newest = max(newest, order)
            if number == receipt.cause and not parcel.repeated >> number & 1:
                round_trip = now - sent_at
        if round_trip is not None:
            self._round_trip.measured(round_trip)
        if count:
            self._newest_taken = max(self._newest_taken, newest)
            self._window.taken(count, newest, self._order, round_trip, now)
        if receipt.is_done or parcel.is_done:
            self._end(parcel)
        elif not receipt.room:
            self._mark_lost([order for order, (owner, _, _) in self._under_way.items() if owner is parcel])
        self._detect_losses(now)
        self._pump(now)

    def _detect_losses(self, now: float) -> None:
        lost = []
        latest = now - self._round_trip.usual
        for order, (_, _, sent_at) in self._under_way.items():
            if order > self._newest_taken - GAP or sent_at > latest:
                break
            lost.append(order)
        self._mark_lost(lost)
        self._window.lost(len(lost))

    def _mark_lost(self, orders: list[int]) -> None:
        for order in orders:
            parcel, number, _ = self._under_way.pop(order)
            parcel.lost(number)

    def _pump(self, now: float) -> None:
        """Send the fragments that the window allows, and set the timer."""
        picked: list[tuple[Parcel, int]] = []
        free = int(self._window.size) - len(self._under_way)
        while len(picked) < free:
            parcel, number = self._next_in_turn()
            if parcel is None:
                break
            self._mark_sent(parcel, number, now)
            picked.append((parcel, number))
        # Each message requests its own receipts: for its last fragment in the burst, and for some in between.
        last = {parcel.key: place for place, (parcel, _) in enumerate(picked)}
        for place, (parcel, number) in enumerate(picked):
            self._send(parcel.part(number, parcel.is_turn() or place == last[parcel.key]))
        self._set_timer(now)

    def _next_in_turn(self) -> tuple[Parcel | None, int]:
        """Return the next message in turn and its fragment to send."""
        turns = self._turns
        self._fill_turns()
        for _ in range(len(turns)):
            parcel = turns[0]
            turns.rotate(-1)
            number = parcel.due()
            if number is not None:
                return parcel, number
        return None, 0

    def _fill_turns(self) -> None:
        turns = self._turns
        if len(turns) < TURNS and len(turns) < len(self.parcels):
            others = (one for one in self.parcels.values() if one not in turns)
            turns.extend(islice(others, TURNS - len(turns)))

    def _mark_sent(self, parcel: Parcel, number: int, now: float) -> None:
        parcel.sent(number, self._order)
        self._under_way[self._order] = (parcel, number, now)
        self._order += 1
        self._sent_at = now

    def _due_at(self) -> float:
        """Return the time of the next action if nothing is received before."""
        if not self._under_way:
            return self._sent_at + min(LONGEST_PROBE, self._patience())
        order, (_, _, sent_at) = next(iter(self._under_way.items()))
        if order <= self._newest_taken - GAP:
            return sent_at + self._round_trip.usual
        return self._sent_at + self._patience()

    def _patience(self) -> float:
        wait = self._round_trip.wait
        return min(LONGEST, max(wait, min(LONGEST_PROBE, wait * BACK_OFF ** min(self._silences, 8))))

    def _set_timer(self, now: float) -> None:
        if not self.parcels:
            cancel(self._timer)
            return
        at = max(now, self._due_at())
        if self._timer is not None and self._timer.active():
            if self._timer.getTime() <= at:
                return  # the timer sees that it is early; resetting it at every receipt would cost more
            self._timer.cancel()
        self._timer = self._clock.callLater(at - now, self._on_timer)

    def _on_timer(self) -> None:
        now = self._clock.seconds()
        for parcel in list(self.parcels.values()):
            if now - parcel.progress_at >= IDLE_S:
                self._end(parcel)
        if self.parcels and now >= self._due_at():
            before = len(self._under_way)
            self._detect_losses(now)
            if len(self._under_way) == before:
                self._probe(now)
        self._pump(now)

    def _probe(self, now: float) -> None:
        """Send probes after a long silence, regardless of window and room; from the third probe on, restart slowly."""
        self._silences += 1
        if self._silences > 2:
            self._window.collapse()
            self._mark_lost(list(self._under_way))
        elif self._under_way:
            self._mark_lost(list(self._under_way)[:PROBES])
        self._fill_turns()
        parcel = self._turns[0]
        self._turns.rotate(-1)
        for _ in range(PROBES):
            number = parcel.due(parcel.count)
            if number is None:
                break
            self._mark_sent(parcel, number, now)
            self._send(parcel.part(number, True))

    def _end(self, parcel: Parcel) -> None:
        del self.parcels[parcel.key]
        for order in parcel.orders.values():
            del self._under_way[order]
        if parcel in self._turns:
            self._turns.remove(parcel)
        self._ended(parcel)
