"""Transfer messages that are larger than a datagram, in fragments.

Outgoing messages go to the ``Flow`` of their peer; incoming fragments are reassembled here. Buffers are limited per
peer and per node. An outgoing message that exceeds a limit is rejected immediately; an incoming message that exceeds a
limit waits at its sender.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

from twisted.internet.interfaces import IDelayedCall, IReactorTime

from middleware.entangled.background import cancel
from middleware.entangled.bounded import put_bounded
from middleware.entangled.errors import Malformed
from middleware.entangled.wire.fragment_sender import IDLE_TIMEOUT_S, Flow, FragmentedMessage
from middleware.entangled.wire.message import (
    MAX_MESSAGE_BYTES,
    Fragment,
    MessageKey,
    count_fragments,
    pack_receipt,
    parse_fragment,
    parse_receipt,
)
from middleware.entangled.wire.session import Session

# Outgoing: eight messages of the maximum size to one peer, so that a burst of writes is accepted; 16 MiB to all peers.
MAX_OUT_PER_PEER_BYTES = 8 * MAX_MESSAGE_BYTES
MAX_OUT_BYTES = 16 * MAX_MESSAGE_BYTES
# Incoming: four messages of the maximum size from one peer; 8 MiB from all peers, a fifth of the memory of an edge
# node.
MAX_IN_PER_PEER_BYTES = 4 * MAX_MESSAGE_BYTES
MAX_IN_BYTES = 8 * MAX_MESSAGE_BYTES
# The number of fragments that all senders together may have under way to this node: as many as fit into the usual
# receive buffer of 208 KiB.
RECEIVE_FRAGMENTS = 128
MIN_RECEIVE_FRAGMENTS = 4
MAX_TRANSFER_S = 60.0
# If the buffer is full, messages that are older than SLOW_AFTER_S seconds and grow by fewer than MIN_FRAGMENTS_PER_S
# fragments per second (88 kbit/s) are dropped. Otherwise a few peers could fill the buffer with messages that they
# never finish.
SLOW_AFTER_S, MIN_FRAGMENTS_PER_S = 1.0, 8.0
CLEARING_INTERVAL_S = 0.5
# After a message of a peer was dropped, the peer may not use this part of the buffer for TARDY_S seconds, so that other
# peers can use it.
RESERVED_BYTES = 2 * MAX_MESSAGE_BYTES
PENALTY_S, MAX_PENALIZED = 60.0, 1024
# The number of completed incoming messages that are remembered; their repeated fragments are acknowledged and dropped.
MAX_COMPLETED = 1024
MAX_FLOWS = 64
PROGRESS_INTERVAL_S = 0.1


@dataclass(slots=True)
class IncomingMessage:
    """A message that is being reassembled. Bit n of ``received`` is set if fragment n has arrived."""

    total: int
    started_at: float
    last_received_at: float
    fragments: list[bytes]
    received: int = 0

    @classmethod
    def empty(cls, total: int, now: float) -> IncomingMessage:
        """Return an empty assembly for a message of ``total`` bytes."""
        return cls(total, now, now, [b""] * count_fragments(total))

    @property
    def is_complete(self) -> bool:
        """Whether every fragment has arrived."""
        return self.received == (1 << len(self.fragments)) - 1

    def is_slow(self, now: float) -> bool:
        """Return whether the message grows so slowly that it may be dropped to free buffer space."""
        age = now - self.started_at
        return age > SLOW_AFTER_S and self.received.bit_count() < MIN_FRAGMENTS_PER_S * age

    def add(self, fragment: Fragment, now: float) -> bool:
        """Store a fragment; return whether to acknowledge it immediately: after a gap, or if it is a duplicate."""
        self.last_received_at = now
        bit = 1 << fragment.number
        if self.received & bit:
            return True
        leaves_gap = bit > 1 and not self.received & (bit >> 1)
        self.received |= bit
        self.fragments[fragment.number] = fragment.data
        return leaves_gap

    def join(self) -> bytes:
        """Return the fragments joined in order."""
        return b"".join(self.fragments)


class Fragmenter:
    """The message fragmenter of an endpoint.

    ``send_sealed`` encrypts bytes for a peer and sends them. ``deliver`` is called with a session and each message that
    has arrived completely. ``first_timeout`` returns the time in seconds to wait for a peer's first receipt.
    ``is_awaited`` returns whether a request to a peer still waits for its answer. ``on_progress`` is called with the id
    of a request of this node and the key of a peer, whenever the peer acknowledged a fragment of the request or a
    fragment of the answer arrived.
    """

    def __init__(
        self,
        clock: IReactorTime,
        send_sealed: Callable[[bytes, bytes], None],
        deliver: Callable[[Session, MessageKey, bytes], None],
        first_timeout: Callable[[bytes], float],
        is_awaited: Callable[[int, bytes], bool],
        on_progress: Callable[[int, bytes], None],
        counters: Counter[str],
    ) -> None:
        self._clock = clock
        self._send_sealed = send_sealed
        self._deliver = deliver
        self._first_timeout = first_timeout
        self._is_awaited = is_awaited
        self._on_progress = on_progress
        self._counters = counters
        self._flows: dict[bytes, Flow] = {}
        self._bytes_out: Counter[bytes] = Counter()
        self._incoming: dict[tuple[bytes, MessageKey], IncomingMessage] = {}
        self._bytes_in: Counter[bytes] = Counter()
        self._completed: dict[tuple[bytes, MessageKey], None] = {}
        self._sweeper: IDelayedCall | None = None
        self._cleared_at = -CLEARING_INTERVAL_S
        self._penalized_at: dict[bytes, float] = {}

    def stop(self) -> None:
        """Forget everything and cancel every timer."""
        for flow in self._flows.values():
            flow.stop()
        cancel(self._sweeper)
        self._flows.clear()
        self._incoming.clear()
        self._bytes_in.clear()
        self._completed.clear()
        self._penalized_at.clear()
        self._bytes_out.clear()

    def reserve(self, public: bytes, size: int) -> bool:
        """Reserve buffer space for a message of ``size`` bytes to a peer until ``release``; return False if full."""
        if self._bytes_out[public] + size > MAX_OUT_PER_PEER_BYTES or self._bytes_out.total() + size > MAX_OUT_BYTES:
            self._counters["crowded"] += 1
            return False
        self._bytes_out[public] += size
        return True

    def release(self, public: bytes, size: int) -> None:
        """Free the buffer space of a message that is no longer buffered."""
        self._bytes_out[public] -= size
        if self._bytes_out[public] <= 0:
            del self._bytes_out[public]

    def send(self, public: bytes, key: MessageKey, message: bytes) -> bool:
        """Send a message to a peer; return False if there is no buffer space for an answer.

        The caller has already reserved the buffer space of a request.
        """
        flow = self._flows.get(public)
        if flow is None:
            flow = self._make_flow(public)
        self._flows[public] = self._flows.pop(public)  # the least recently used flow is first
        if key in flow.messages:
            return True  # the message is already under way
        if key.is_answer and not self.reserve(public, len(message)):
            return False
        flow.send(key, message)
        return True

    def is_sending(self, public: bytes, key: MessageKey) -> bool:
        """Return whether a message is under way to a peer and not yet completely acknowledged."""
        flow = self._flows.get(public)
        return flow is not None and key in flow.messages

    def drop(self, public: bytes, key: MessageKey) -> None:
        """Stop sending a message to a peer."""
        flow = self._flows.get(public)
        if flow is not None:
            flow.drop(key)

    def restart(self, public: bytes) -> None:
        """Send the messages to a peer again in its new session, because a restarted peer lost the earlier fragments."""
        flow = self._flows.get(public)
        if flow is not None and flow.messages:
            flow.restart()

    def evict(self, public: bytes) -> None:
        """Forget all messages to and from a peer."""
        flow = self._flows.get(public)
        for key in list(flow.messages) if flow is not None else ():
            self.drop(public, key)
        for where in [where for where in self._incoming if where[0] == public]:
            self.forget_incoming(*where)

    def forget_flow(self, public: bytes) -> None:
        """Forget the congestion state of the path to a peer, if no message is under way."""
        flow = self._flows.get(public)
        if flow is not None and not flow.messages:
            del self._flows[public]

    def on_receipt(self, session: Session, plain: bytes) -> None:
        """Process a RECEIPT."""
        try:
            receipt = parse_receipt(plain)
        except Malformed:
            self._counters["malformed"] += 1
            return
        public = session.contact.public
        flow = self._flows.get(public)
        if flow is not None and receipt.key in flow.messages:
            now = self._clock.seconds()
            if now - flow.progress_reported_at >= PROGRESS_INTERVAL_S:
                # Requests that wait for their turn are also considered to make progress.
                flow.progress_reported_at = now
                for key in flow.messages:
                    if not key.is_answer:
                        self._on_progress(key.id, public)
            flow.process_receipt(receipt)

    def on_fragment(self, session: Session, plain: bytes) -> None:
        """Process a PART."""
        try:
            fragment = parse_fragment(plain)
        except Malformed:
            self._counters["malformed"] += 1
            return
        now, public, key = self._clock.seconds(), session.contact.public, fragment.key
        where = (public, key)
        assembly = self._incoming.get(where)
        if assembly is None:
            is_over = not self._is_awaited(key.id, public) if key.is_answer else where in self._completed
            if is_over:
                self._counters["unasked" if key.is_answer else "repeated"] += 1
                if fragment.wants_receipt:
                    self._send_sealed(public, pack_receipt(key, True, 0, fragment.number, 0))
                return
            if not self._has_room(public, fragment.total, now):
                self._counters["crowded"] += 1
                if fragment.wants_receipt:
                    self._send_sealed(public, pack_receipt(key, False, 0, fragment.number, 0))
                return
            assembly = self._incoming[where] = IncomingMessage.empty(fragment.total, now)
            self._bytes_in[public] += fragment.total
            if self._sweeper is None or not self._sweeper.active():
                self._sweeper = self._clock.callLater(1.0, self._sweep)
        elif assembly.total != fragment.total:
            self._counters["malformed"] += 1
            return
        is_urgent = assembly.add(fragment, now)
        if assembly.is_complete:
            self.forget_incoming(public, key)
            if not key.is_answer:
                put_bounded(self._completed, where, None, MAX_COMPLETED)
            self._send_sealed(public, pack_receipt(key, True, 0, fragment.number, assembly.received))
            self._deliver(session, key, assembly.join())
            return
        if is_urgent or fragment.wants_receipt:
            room = max(MIN_RECEIVE_FRAGMENTS, RECEIVE_FRAGMENTS // len(self._incoming))
            self._send_sealed(public, pack_receipt(key, False, room, fragment.number, assembly.received))
        if key.is_answer:
            self._on_progress(key.id, public)

    def _has_room(self, public: bytes, size: int, now: float) -> bool:
        """Return whether one more message from a peer can be buffered; drop slow messages to free space."""
        if self._bytes_in[public] + size > MAX_IN_PER_PEER_BYTES:
            return False
        most = (
            MAX_IN_BYTES - RESERVED_BYTES
            if now - self._penalized_at.get(public, -PENALTY_S) < PENALTY_S
            else MAX_IN_BYTES
        )
        if self._bytes_in.total() + size > MAX_IN_BYTES and now - self._cleared_at >= CLEARING_INTERVAL_S:
            self._cleared_at = now
            for where in [where for where, assembly in self._incoming.items() if assembly.is_slow(now)]:
                self._drop_incoming(where, now)
        return self._bytes_in.total() + size <= most

    def _drop_incoming(self, where: tuple[bytes, MessageKey], now: float) -> None:
        self._counters["abandoned"] += 1
        self.forget_incoming(*where)
        put_bounded(self._penalized_at, where[0], now, MAX_PENALIZED)

    def _make_flow(self, public: bytes) -> Flow:
        if len(self._flows) >= MAX_FLOWS:
            idle = [other for other, flow in self._flows.items() if not flow.messages]
            for other in idle[:1]:
                del self._flows[other]

        def on_ended(message: FragmentedMessage) -> None:
            if message.key.is_answer:
                self.release(public, len(message.data))

        flow = Flow(self._clock, lambda plain: self._send_sealed(public, plain), on_ended, self._first_timeout(public))
        self._flows[public] = flow
        return flow

    def forget_incoming(self, public: bytes, key: MessageKey) -> None:
        """Forget the fragments of a message from a peer."""
        assembly = self._incoming.pop((public, key), None)
        if assembly is not None:
            self._bytes_in[public] -= assembly.total
            if not self._bytes_in[public]:
                del self._bytes_in[public]
            if not self._incoming:
                cancel(self._sweeper)

    def _sweep(self) -> None:
        """Drop messages without a new fragment for ``IDLE_TIMEOUT_S``, and messages older than ``MAX_TRANSFER_S``."""
        now = self._clock.seconds()
        for where, assembly in list(self._incoming.items()):
            if now - assembly.last_received_at >= IDLE_TIMEOUT_S or now - assembly.started_at >= MAX_TRANSFER_S:
                self._drop_incoming(where, now)
        if self._incoming:
            self._sweeper = self._clock.callLater(1.0, self._sweep)
