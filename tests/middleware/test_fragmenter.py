"""Tests of large messages: integrity, loss, limits and flow control."""

from __future__ import annotations

import random
from typing import Any

from middleware.entangled.contact import Contact
from middleware.entangled.errors import Crowded, NoAnswer, Refused, TooLarge
from middleware.entangled.network.switchboard import LinkConditions
from middleware.entangled.wire import fragmenter
from middleware.entangled.wire.fragment_sender import IDLE_TIMEOUT_S
from middleware.entangled.wire.fragmenter import MAX_OUT_PER_PEER_BYTES, IncomingMessage
from middleware.entangled.wire.message import (
    FRAGMENT_BYTES,
    MAX_MESSAGE_BYTES,
    PART,
    RECEIPT,
    Fragment,
    MessageKey,
    Request,
    count_fragments,
    encode,
    pack_receipt,
    parse_receipt,
)
from middleware.entangled.wire.peer import SESSION_END_S
from middleware.entangled.wire.session import INIT, MAX_PLAIN_BYTES, MIN_INIT_BYTES
from tests.middleware.test_endpoint import DELAY, EndpointCase

MIB = 2**20
LARGE = random.Random(5).randbytes(MIB)


class FragmenterCase(EndpointCase):
    """A test case in which ``b`` accepts and returns large values."""

    def equip(self, endpoint: Any) -> None:
        """Register the methods."""
        super().equip(endpoint)
        endpoint.expose("size", self.size, changes=True)
        endpoint.expose("large", lambda peer, size: LARGE[:size])

    def size(self, peer: Contact, value: bytes) -> int:
        """Record the size of the value."""
        self.runs.append(len(value))
        return len(value)

    def part(self, number: int, total: int = MAX_MESSAGE_BYTES, id_: int = 77, data: bytes | None = None) -> bytes:
        """Return a fragment of a request, with fields that a malicious member chooses."""
        data = bytes(min(FRAGMENT_BYTES, total - number * FRAGMENT_BYTES)) if data is None else data
        return (
            bytes([PART, 2])
            + id_.to_bytes(8, "little")
            + total.to_bytes(4, "little")
            + number.to_bytes(2, "little")
            + data
        )

    def fire(self, plain: bytes) -> list[bytes]:
        """Send a message from ``a`` to ``b`` and return the replies."""
        session = next(iter(self.a._sessions.values()))
        got: list[bytes] = []
        receivers = self.taps[self.to_a.address]
        before = len(receivers.kept)
        self.taps[self.to_b.address].receiver(session.seal(plain), self.to_a.address)
        self.clock.advance(2 * DELAY)
        for datagram, _ in receivers.kept[before:]:
            twin = next(iter(self.a._sessions.values()))
            twin._seen = 0
            twin._highest = -1
            got.append(twin.open(datagram)[0])
        return got


class FragmenterTests(FragmenterCase):
    """Tests of large requests and replies."""

    def test_every_size(self) -> None:
        """A value of up to 1 MiB arrives unchanged in both directions; a larger value fails before it is sent."""
        self.failureResultOf(self.a.ask(self.to_b, "size", bytes(MAX_MESSAGE_BYTES)), TooLarge)
        self.assertEqual(self.switchboard.counters["sent"], 0)
        self.assertEqual(self.got(self.a.ask(self.to_b, "size", bytes(MIB + 4000), changes=True), 9), MIB + 4000)
        around = [n * FRAGMENT_BYTES + d for n in (1, 2, 10) for d in (-60, -40, -32, -31, -30, -20, -1, 0, 1)]
        for size in (0, 1, MAX_PLAIN_BYTES - 40, *around, 65536, MIB):
            self.assertEqual(self.got(self.a.ask(self.to_b, "echo", LARGE[:size])), LARGE[:size], size)

    def test_loss(self) -> None:
        """1 MiB in each direction arrives unchanged under 5 % loss within 2 s, and under 30 % loss within 22 s."""
        for loss, longest in ((0.05, 2.0), (0.3, 22.0)):
            self.switchboard.conditions = LinkConditions(DELAY, DELAY / 4, loss=loss, duplicate=0.02, reorder=0.05)
            asked = self.a.ask(self.to_b, "echo", LARGE)
            self.assertEqual(self.got(asked, longest), LARGE, loss)

    def test_large_changes_run_once(self) -> None:
        """A large request that changes state runs once under loss and duplication."""
        self.switchboard.conditions = LinkConditions(DELAY, DELAY / 2, loss=0.2, duplicate=0.3, reorder=0.3)
        for number in range(30):
            asked = self.a.ask(self.to_b, "size", bytes(3000 + number), changes=True)
            self.assertEqual(self.got(asked, 10.0), 3000 + number)
        self.assertEqual(self.runs, [3000 + number for number in range(30)])

    def test_silence_in_the_middle(self) -> None:
        """If a peer fails during a transfer, the request fails at its timeout, and both sides free all buffers."""
        asked = self.a.ask(self.to_b, "echo", LARGE)
        self.clock.advance(1.5 * DELAY)
        self.assertEqual([len(d) for d, _ in self.kept(self.to_b, INIT)], [MIN_INIT_BYTES])
        self.clock.advance(10 * DELAY)
        self.switchboard.cut(self.to_a.address, self.to_b.address)
        self.failed(asked, NoAnswer, 4.0)
        self.clock.advance(IDLE_TIMEOUT_S + 2)
        self.assertEqual((self.b._fragmenter._incoming, dict(self.b._fragmenter._bytes_in)), ({}, {}))
        self.assertEqual(dict(self.a._fragmenter._bytes_out), {})
        self.assertEqual(self.b.counters["abandoned"], 1)
        self.clock.advance(SESSION_END_S)
        self.assertEqual(self.clock.getDelayedCalls(), [])

    def test_a_short_break_is_survived(self) -> None:
        """A transfer continues after an interruption of one second, and after a restart of the peer."""
        self.got(self.a.ask(self.to_b, "echo", 1))
        asked = self.a.ask(self.to_b, "size", LARGE, changes=True)
        self.clock.advance(4 * DELAY)
        self.switchboard.cut(self.to_a.address, self.to_b.address)
        self.clock.advance(1.0)
        self.switchboard.heal()
        self.assertEqual(self.got(asked, 8.0), MIB)
        asked = self.a.ask(self.to_b, "size", LARGE, changes=True)
        self.clock.advance(4 * DELAY)
        self.switchboard.kill(self.to_b.address)
        self.b, self.to_b = self.endpoint(7, port=self.to_b.address.port, identity=2)
        self.equip(self.b)
        self.assertEqual(self.got(asked, 8.0), MIB)

    def test_back_pressure(self) -> None:
        """The number of fragments in flight never exceeds the window of the receiver."""
        asked = self.a.ask(self.to_b, "echo", LARGE)
        most = 0
        while not asked.called:
            self.clock.advance(DELAY / 4)
            flow = self.a._fragmenter._flows.get(self.to_b.public)
            most = max(most, len(flow._in_flight) if flow is not None else 0)
        self.assertGreater(most, 100)
        self.assertLessEqual(most, fragmenter.RECEIVE_FRAGMENTS + 2)

    def test_small_talk_goes_on(self) -> None:
        """During transfers of 4 MiB a small request to the same peer is answered immediately."""
        self.got(self.a.ask(self.to_b, "echo", 1))
        asked = [self.a.ask(self.to_b, "size", LARGE, changes=True) for _ in range(4)]
        self.clock.advance(4 * DELAY)
        self.assertEqual(self.got(self.a.ask(self.to_b, "echo", 2), 2.5 * DELAY), 2)
        self.clock.advance(10)
        self.assertEqual([self.successResultOf(one) for one in asked], [MIB] * 4)

    def test_room_is_reserved(self) -> None:
        """A large request that exceeds the limit for one peer fails with ``Crowded``; finished requests free space."""
        fitting = MAX_OUT_PER_PEER_BYTES // (MIB + 60)
        asked = [self.a.ask(self.to_b, "size", LARGE, changes=True) for _ in range(fitting)]
        self.failureResultOf(self.a.ask(self.to_b, "size", LARGE, changes=True), Crowded)
        self.clock.advance(30)
        self.assertEqual([self.successResultOf(one) for one in asked], [MIB] * fitting)
        self.assertEqual(dict(self.a._fragmenter._bytes_out), {})
        self.assertEqual(self.got(self.a.ask(self.to_b, "size", LARGE, changes=True), 9), MIB)

    def test_parcels_side_by_side(self) -> None:
        """Several messages to one peer share the path fairly; without loss no fragment is retransmitted."""
        for delay in (DELAY, 0.0):
            self.switchboard.conditions = LinkConditions(delay)
            self.got(self.a.ask(self.to_b, "echo", 1))
            self.taps[self.to_b.address].kept.clear()
            asked = [self.a.ask(self.to_b, "size", LARGE[: 300_000 + n], changes=True) for n in range(3)]
            self.clock.advance(5)
            self.assertEqual([self.successResultOf(one) for one in asked], [300_000, 300_001, 300_002])
            parts = [d for d, _ in self.taps[self.to_b.address].kept if len(d) == 1400]
            self.assertLessEqual(len(parts), 3 * count_fragments(300_060) + 3, delay)


class HostileTests(FragmenterCase):
    """Tests of fragments that a malicious member creates."""

    def setUp(self) -> None:
        """Open a session."""
        super().setUp()
        self.got(self.a.ask(self.to_b, "echo", 1))

    def test_late_parts_begin_nothing(self) -> None:
        """A fragment of a completed request, or of an unsolicited reply, does not start a message."""
        self.got(self.a.ask(self.to_b, "echo", LARGE[:5000]))
        key = next(iter(self.b._fragmenter._completed))[1]
        got = self.fire(self.part(1, 5030, key.id))
        self.assertEqual([parse_receipt(plain).is_done for plain in got], [True])
        self.fire(b"\x01\x03" + self.part(0)[2:])
        counted = [self.b.counters[name] for name in ("repeated", "unasked")]
        self.assertEqual((counted, self.b._fragmenter._incoming), ([1, 1], {}))

    def test_a_parcel_must_be_what_it_says(self) -> None:
        """A request is dropped and not executed if its id differs from the id in its fragments."""
        message = encode(Request(5, "add", (b"x" * 2000,)))
        for number in range(2):
            data = message[number * FRAGMENT_BYTES : (number + 1) * FRAGMENT_BYTES]
            self.fire(self.part(number, len(message), 6, data))
        self.assertEqual((self.b.counters["malformed"], self.runs), (1, []))

    def test_receipts(self) -> None:
        """An acknowledgement lists the received fragments in minimal encoding, whatever their order of arrival."""
        assembly = IncomingMessage.empty(10 * FRAGMENT_BYTES, 0.0)
        for number, is_urgent in ((0, False), (1, False), (4, True), (5, False), (4, True), (2, False)):
            part = Fragment(MessageKey(False, 1), False, 10 * FRAGMENT_BYTES, number, bytes(FRAGMENT_BYTES))
            self.assertEqual(assembly.add(part, 1.0), is_urgent, number)
        packed = pack_receipt(MessageKey(True, 9), False, 7, 2, assembly.received)
        self.assertEqual(len(packed), 17)
        self.assertEqual(packed[0], RECEIPT)
        receipt = parse_receipt(packed)
        self.assertEqual((receipt.next, receipt.room, receipt.cause, receipt.received), (3, 7, 2, 0b110111))
        self.assertFalse(assembly.is_complete)

    def test_receipts_for_nothing(self) -> None:
        """Acknowledgements of unsent fragments have no effect."""
        for here in (1, 2**900, 0):
            self.fire(pack_receipt(MessageKey(False, 1), False, 9, 3, here))
        asked = self.b.ask(Contact(self.to_a.public, self.to_a.address), "x", LARGE)
        self.clock.advance(DELAY)
        number = next(iter(self.b._requester._requests))
        self.fire(pack_receipt(MessageKey(False, number), False, 65535, 0, 2**900))
        self.assertFalse(self.failed(asked, Refused) == "")
