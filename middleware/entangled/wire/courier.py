"""Courier: carries parcels: hands those that go out to flows, puts together those that come in, and keeps the bounds.

What waits here is bounded by peer and by node: a message that finds no room to go out is refused at once, and one that
finds no room to come in waits at its sender.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

from twisted.internet.interfaces import IDelayedCall, IReactorTime

from middleware.entangled.background import cancel
from middleware.entangled.bounded import keep
from middleware.entangled.errors import Malformed
from middleware.entangled.wire.flow import IDLE_S, Flow, Parcel
from middleware.entangled.wire.message import (
    MAX_MESSAGE,
    Key,
    Part,
    packed_receipt,
    part_count,
    part_of,
    receipt_of,
)
from middleware.entangled.wire.session import Session

# Going out: eight of the largest to one peer, so that a burst of writes is not refused; 16 MiB in all.
MAX_OUT_OF_PEER = 8 * MAX_MESSAGE
MAX_OUT = 16 * MAX_MESSAGE
# Coming in: four of the largest of one peer, 8 MiB in all: a fifth of an edge node's memory.
MAX_IN_OF_PEER = 4 * MAX_MESSAGE
MAX_IN = 8 * MAX_MESSAGE
# The parts that all senders together may have under way to us: what the usual receive buffer of 208 KiB holds.
ROOM_PARTS = 128
LEAST_ROOM = 4
LONGEST_S = 60.0
# Where there is no room for one more, parcels that are older than this and grow more slowly than so many parts (88
# kbit/s) in a second are given up: else a few members could hold all the room with parcels that they never finish.
SETTLED_S, SLOW = 1.0, 8.0
CLEARING_S = 0.5
# Whose parcel was given up does not get this part of the room for a while; so it is there for others.
KEPT_FREE = 2 * MAX_MESSAGE
TARDY_S, MAX_TARDY = 60.0, 1024
# Of this many questions a receiver knows that it has had them; their repeated parts get a receipt and are dropped.
MAX_ENDED = 1024
MAX_FLOWS = 64
TELL_S = 0.1


@dataclass(slots=True)
class Assembly:
    """A parcel that arrives.  ``here`` has bit n set where part n has come."""

    total: int
    begun_at: float
    heard_at: float
    parts: list[bytes]
    here: int = 0

    @classmethod
    def of(cls, total: int, now: float) -> Assembly:
        """An empty one."""
        return cls(total, now, now, [b""] * part_count(total))

    @property
    def is_whole(self) -> bool:
        """Whether every part is here."""
        return self.here == (1 << len(self.parts)) - 1

    def is_slow(self, now: float) -> bool:
        """Whether it has to give way to others where room is short."""
        age = now - self.begun_at
        return age > SETTLED_S and self.here.bit_count() < SLOW * age

    def add(self, part: Part, now: float) -> bool:
        """Put a part into its place; whether to tell its sender at once, since it leaves a gap or is here twice."""
        self.heard_at = now
        bit = 1 << part.number
        if self.here & bit:
            return True
        leaves_gap = bit > 1 and not self.here & (bit >> 1)
        self.here |= bit
        self.parts[part.number] = part.data
        return leaves_gap

    def message(self) -> bytes:
        """What the parts make together."""
        return b"".join(self.parts)


class Courier:
    """Carries parcels for an endpoint.

    ``send`` seals bytes for a peer, ``deliver`` is called with a session and each message that has arrived whole,
    ``first_wait`` says how long to wait for a peer's first receipt, ``is_awaited`` whether anybody waits for the answer
    of a peer to a question.  ``on_progress`` is called with the id of a question of ours and a peer whenever the peer
    got a part of it, or we one of the answer.
    """

    def __init__(
        self,
        clock: IReactorTime,
        send: Callable[[bytes, bytes], None],
        deliver: Callable[[Session, Key, bytes], None],
        first_wait: Callable[[bytes], float],
        is_awaited: Callable[[int, bytes], bool],
        on_progress: Callable[[int, bytes], None],
        counters: Counter[str],
    ) -> None:
        self._clock = clock
        self._send = send
        self._deliver = deliver
        self._first_wait = first_wait
        self._is_awaited = is_awaited
        self._on_progress = on_progress
        self._counters = counters
        self._flows: dict[bytes, Flow] = {}
        self._bytes_out: Counter[bytes] = Counter()
        self._assemblies: dict[tuple[bytes, Key], Assembly] = {}
        self._bytes_in: Counter[bytes] = Counter()
        self._ended: dict[tuple[bytes, Key], None] = {}
        self._sweeper: IDelayedCall | None = None
        self._cleared_at = -CLEARING_S
        self._tardy: dict[bytes, float] = {}

    def stop(self) -> None:
        """Forget everything and cancel every timer."""
        for flow in self._flows.values():
            flow.stop()
        cancel(self._sweeper)
        self._flows.clear()
        self._assemblies.clear()
        self._bytes_in.clear()
        self._ended.clear()
        self._tardy.clear()
        self._bytes_out.clear()

    def reserve(self, public: bytes, size: int) -> bool:
        """Whether a message of ``size`` bytes may wait here for a peer; it counts until it is ``released``."""
        if self._bytes_out[public] + size > MAX_OUT_OF_PEER or self._bytes_out.total() + size > MAX_OUT:
            self._counters["crowded"] += 1
            return False
        self._bytes_out[public] += size
        return True

    def release(self, public: bytes, size: int) -> None:
        """Take note that a message for which there was room is not held any more."""
        self._bytes_out[public] -= size
        if self._bytes_out[public] <= 0:
            del self._bytes_out[public]

    def post(self, public: bytes, key: Key, message: bytes) -> bool:
        """Carry a message to a peer.  A question has its room already; False where an answer finds none."""
        flow = self._flows.get(public)
        if flow is None:
            flow = self._new_flow(public)
        self._flows[public] = self._flows.pop(public)  # whichever was used longest ago stands first
        if key in flow.parcels:
            return True  # it is under way
        if key.is_answer and not self.reserve(public, len(message)):
            return False
        flow.post(key, message)
        return True

    def is_carrying(self, public: bytes, key: Key) -> bool:
        """Whether a message is under way to a peer and not yet acknowledged whole."""
        flow = self._flows.get(public)
        return flow is not None and key in flow.parcels

    def drop(self, public: bytes, key: Key) -> None:
        """Stop carrying a message to a peer."""
        flow = self._flows.get(public)
        if flow is not None:
            flow.drop(key)

    def restart(self, public: bytes) -> None:
        """Begin what goes to a peer anew: there is a new session, so perhaps the peer was restarted."""
        flow = self._flows.get(public)
        if flow is not None and flow.parcels:
            flow.restart()

    def evict(self, public: bytes) -> None:
        """Forget what goes to a peer and comes from it."""
        flow = self._flows.get(public)
        for key in list(flow.parcels) if flow is not None else ():
            self.drop(public, key)
        for where in [where for where in self._assemblies if where[0] == public]:
            self.forget(*where)

    def let_go(self, public: bytes) -> None:
        """Forget how fast the way to a peer is, where nothing goes there."""
        flow = self._flows.get(public)
        if flow is not None and not flow.parcels:
            del self._flows[public]

    def on_receipt(self, session: Session, plain: bytes) -> None:
        """Take a RECEIPT."""
        try:
            receipt = receipt_of(plain)
        except Malformed:
            self._counters["malformed"] += 1
            return
        public = session.contact.public
        flow = self._flows.get(public)
        if flow is not None and receipt.key in flow.parcels:
            now = self._clock.seconds()
            if now - flow.told_at >= TELL_S:
                # Those that wait for their turn make progress, too.
                flow.told_at = now
                for key in flow.parcels:
                    if not key.is_answer:
                        self._on_progress(key.id, public)
            flow.take(receipt)

    def on_part(self, session: Session, plain: bytes) -> None:
        """Take a PART."""
        try:
            part = part_of(plain)
        except Malformed:
            self._counters["malformed"] += 1
            return
        now, public, key = self._clock.seconds(), session.contact.public, part.key
        where = (public, key)
        assembly = self._assemblies.get(where)
        if assembly is None:
            is_over = not self._is_awaited(key.id, public) if key.is_answer else where in self._ended
            if is_over:
                self._counters["unasked" if key.is_answer else "repeated"] += 1
                if part.is_wanted:
                    self._send(public, packed_receipt(key, True, 0, part.number, 0))
                return
            if not self._has_room(public, part.total, now):
                self._counters["crowded"] += 1
                if part.is_wanted:
                    self._send(public, packed_receipt(key, False, 0, part.number, 0))
                return
            assembly = self._assemblies[where] = Assembly.of(part.total, now)
            self._bytes_in[public] += part.total
            if self._sweeper is None or not self._sweeper.active():
                self._sweeper = self._clock.callLater(1.0, self._sweep)
        elif assembly.total != part.total:
            self._counters["malformed"] += 1
            return
        is_urgent = assembly.add(part, now)
        if assembly.is_whole:
            self.forget(public, key)
            if not key.is_answer:
                keep(self._ended, where, None, MAX_ENDED)
            self._send(public, packed_receipt(key, True, 0, part.number, assembly.here))
            self._deliver(session, key, assembly.message())
            return
        if is_urgent or part.is_wanted:
            room = max(LEAST_ROOM, ROOM_PARTS // len(self._assemblies))
            self._send(public, packed_receipt(key, False, room, part.number, assembly.here))
        if key.is_answer:
            self._on_progress(key.id, public)

    def _has_room(self, public: bytes, size: int, now: float) -> bool:
        """Whether another parcel of a peer can come in; slow ones make room for it."""
        if self._bytes_in[public] + size > MAX_IN_OF_PEER:
            return False
        most = MAX_IN - KEPT_FREE if now - self._tardy.get(public, -TARDY_S) < TARDY_S else MAX_IN
        if self._bytes_in.total() + size > MAX_IN and now - self._cleared_at >= CLEARING_S:
            self._cleared_at = now
            for where in [where for where, assembly in self._assemblies.items() if assembly.is_slow(now)]:
                self._give_up(where, now)
        return self._bytes_in.total() + size <= most

    def _give_up(self, where: tuple[bytes, Key], now: float) -> None:
        self._counters["abandoned"] += 1
        self.forget(*where)
        keep(self._tardy, where[0], now, MAX_TARDY)

    def _new_flow(self, public: bytes) -> Flow:
        if len(self._flows) >= MAX_FLOWS:
            idle = [other for other, flow in self._flows.items() if not flow.parcels]
            for other in idle[:1]:
                del self._flows[other]

        def carried(parcel: Parcel) -> None:
            if parcel.key.is_answer:
                self.release(public, len(parcel.data))

        flow = Flow(self._clock, lambda plain: self._send(public, plain), carried, self._first_wait(public))
        self._flows[public] = flow
        return flow

    def forget(self, public: bytes, key: Key) -> None:
        """Forget what has come of a message from a peer."""
        assembly = self._assemblies.pop((public, key), None)
        if assembly is not None:
            self._bytes_in[public] -= assembly.total
            if not self._bytes_in[public]:
                del self._bytes_in[public]
            if not self._assemblies:
                cancel(self._sweeper)

    def _sweep(self) -> None:
        """Forget what has not grown for ``IDLE_S``, or takes longer than ``LONGEST_S``."""
        now = self._clock.seconds()
        for where, assembly in list(self._assemblies.items()):
            if now - assembly.heard_at >= IDLE_S or now - assembly.begun_at >= LONGEST_S:
                self._give_up(where, now)
        if self._assemblies:
            self._sweeper = self._clock.callLater(1.0, self._sweep)
