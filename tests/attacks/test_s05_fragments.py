"""Attack S5: send fragments that never form a message, overlap, claim huge sizes, or come from many members."""

from __future__ import annotations

import random
import tracemalloc
from collections import Counter
from typing import Any

from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.clock import HeapClock
from middleware.entangled.identity import Identity
from middleware.entangled.wire.fragment_sender import IDLE_TIMEOUT_S
from middleware.entangled.wire.fragmenter import MAX_IN_BYTES, MAX_IN_PER_PEER_BYTES, Fragmenter
from middleware.entangled.wire.message import FRAGMENT_BYTES, MAX_FRAGMENTS, MAX_MESSAGE_BYTES, PART, MessageKey
from tests.attacks.siege import OneSession
from tests.fuzz.ground import Ground

KIB = 1024
HALF = MAX_MESSAGE_BYTES // 2


def part(number: int, total: int, place: int, data: bytes, is_wanted: bool = False) -> bytes:
    """Return an arbitrary fragment (PART)."""
    head = bytes([PART, 2 if is_wanted else 0]) + number.to_bytes(8, "little")
    return head + total.to_bytes(4, "little") + place.to_bytes(2, "little") + data


class FragmenterCase(SynchronousTestCase):
    """A test case with a fragmenter that receives from members with a number as their name."""

    def setUp(self) -> None:
        self.clock = HeapClock()
        self.counters: Counter[str] = Counter()
        self.delivered: list[tuple[bytes, int]] = []
        self.receipts: list[bytes] = []
        self.fragmenter = Fragmenter(
            self.clock,
            lambda public, plain: self.receipts.append(plain),
            lambda session, key, data: self.delivered.append((session.contact.public, len(data))),
            lambda public: 0.3,
            lambda number, public: False,
            lambda number, public: None,
            self.counters,
        )
        self.addCleanup(self.fragmenter.stop)

    def take(self, member: int, plain: bytes) -> None:
        session: Any = OneSession(member.to_bytes(32, "little"))
        self.fragmenter.on_fragment(session, plain)

    def bytes_in(self) -> int:
        """Return the bytes reserved for incoming messages."""
        return self.fragmenter._bytes_in.total()

    def send_whole(self, member: int, number: int, size: int) -> None:
        """Send a valid message as fragments, in order."""
        for place in range(-(-size // FRAGMENT_BYTES)):
            here = min(FRAGMENT_BYTES, size - place * FRAGMENT_BYTES)
            self.take(member, part(number, size, place, bytes(here), True))


class FragmentTests(FragmenterCase):
    def test_never_completed(self) -> None:
        """Incomplete messages of a member take at most the member's share of the space, and are deleted after 10 s."""
        for number in range(2000):
            self.take(1, part(number, HALF, 0, bytes(FRAGMENT_BYTES)))
        self.assertLessEqual(self.bytes_in(), MAX_IN_PER_PEER_BYTES)
        self.assertGreater(self.counters["crowded"], 1900)
        self.clock.advance(IDLE_TIMEOUT_S + 2.0)
        self.assertEqual((self.bytes_in(), len(self.fragmenter._incoming)), (0, 0))

    def test_lies_about_its_size(self) -> None:
        """Fragments with an invalid size or position, or a different total size, are malformed and reserve nothing."""
        wrong = (
            part(1, 2**32 - 1, 0, bytes(FRAGMENT_BYTES)),
            part(1, MAX_MESSAGE_BYTES + 1, 0, bytes(FRAGMENT_BYTES)),
            part(1, HALF, 65535, bytes(FRAGMENT_BYTES)),
            part(1, HALF, MAX_FRAGMENTS, bytes(FRAGMENT_BYTES)),
            part(1, HALF, 0, bytes(FRAGMENT_BYTES - 1)),
            part(1, 0, 0, b""),
            part(1, 10, 1, b""),
        )
        for plain in wrong:
            self.take(1, plain)
        self.assertEqual((self.counters["malformed"], self.bytes_in()), (len(wrong), 0))
        self.take(1, part(1, HALF, 0, bytes(FRAGMENT_BYTES)))
        self.take(1, part(1, HALF - 5, 1, bytes(FRAGMENT_BYTES)))
        self.assertEqual(self.counters["malformed"], len(wrong) + 1)

    def test_overlapping(self) -> None:
        """A message with overlapping fragments is delivered once, with the announced length."""
        size = 3 * FRAGMENT_BYTES
        for fill in (b"a", b"b", b"a"):
            for place in (0, 2):
                self.take(1, part(1, size, place, fill * FRAGMENT_BYTES))
        self.take(1, part(1, size, 1, b"c" * FRAGMENT_BYTES))
        self.take(1, part(1, size, 1, b"d" * FRAGMENT_BYTES))
        self.assertEqual(self.delivered, [((1).to_bytes(32, "little"), size)])
        self.assertEqual(self.counters["repeated"], 1)

    def test_interleaved_from_a_thousand(self) -> None:
        """Unfinished messages of a thousand members stay within the limit, also in allocated memory."""
        tracemalloc.start()
        self.addCleanup(tracemalloc.stop)
        base, _ = tracemalloc.get_traced_memory()
        for round_ in range(8):
            for member in range(1000):
                self.take(member, part(round_ // 4, 64 * KIB, round_ % 4, bytes(FRAGMENT_BYTES)))
        used, _ = tracemalloc.get_traced_memory()
        self.assertLessEqual(self.bytes_in(), MAX_IN_BYTES)
        self.assertLess(used - base, MAX_IN_BYTES * 1.1)

    def test_others_get_through(self) -> None:
        """If messages that grow slowly take all the space, another message of 64 KiB arrives within two seconds."""
        for member in range(2, 200):
            self.take(member, part(1, 64 * KIB, 0, bytes(FRAGMENT_BYTES)))
        self.assertGreater(self.bytes_in(), MAX_IN_BYTES - 64 * KIB)
        for second in range(20):
            self.clock.advance(0.1)
            for member in range(2, 200):
                if second % 5 == 0:
                    self.take(member, part(1, 64 * KIB, second + 1, bytes(FRAGMENT_BYTES)))
            self.send_whole(1, 1, 64 * KIB)
            if self.delivered:
                break
        self.assertEqual(self.delivered, [((1).to_bytes(32, "little"), 64 * KIB)])

    def test_busy_ones_are_not_pushed_out(self) -> None:
        """A message that grows quickly is not evicted."""
        for member in range(2, 120):
            self.take(member, part(1, 64 * KIB, 0, bytes(FRAGMENT_BYTES)))
        size = 60 * KIB
        for place in range(30):
            self.take(1, part(1, size, place, bytes(FRAGMENT_BYTES)))
        self.clock.advance(1.5)
        for member in range(200, 300):
            self.take(member, part(1, 64 * KIB, 0, bytes(FRAGMENT_BYTES)))
        self.assertTrue(((1).to_bytes(32, "little"), MessageKey(False, 1)) in self.fragmenter._incoming)


class EndToEndTests(SynchronousTestCase):
    def test_a_transfer_beside(self) -> None:
        """A member's message of 64 KiB arrives while unfinished messages of the same member fill its share."""
        ground = Ground()
        self.addCleanup(ground.stop)
        session = next(iter(ground.other._sessions.values()))
        dice = random.Random(1)
        for number in range(500):
            plain = part(dice.getrandbits(60), HALF, number % 300, bytes(FRAGMENT_BYTES))
            ground.shoot(session.seal(plain), ground.other.address)
        asked = ground.other.ask(ground.contact, "echo", bytes(64 * KIB), timeout=30.0)
        ground.clock.advance(IDLE_TIMEOUT_S + 20.0)
        self.assertEqual(len(self.successResultOf(asked)), 64 * KIB)
        self.assertEqual(Identity(b"o" * 32).public, ground.identity.public)
