"""Tests of camera streams from a publisher to its viewers on a switchboard."""

from __future__ import annotations

import random

from middleware.entangled.contact import Contact
from middleware.entangled.errors import Refused
from middleware.entangled.network.network import Address
from middleware.entangled.streams import MAX_PARTS, MAX_VIEWERS, PART_BYTES, SUBSCRIPTION_TTL_S, Streams
from tests.middleware.test_endpoint import DELAY, EndpointCase

CAMERA = "camera"


class StreamsTests(EndpointCase):
    """Tests of streams that ``b`` publishes and ``a`` views."""

    def setUp(self) -> None:
        super().setUp()
        self.publisher, self.viewer = Streams(self.b, self.clock), Streams(self.a, self.clock)
        self.to_publisher, self.to_viewer = self.to_b, self.to_a
        self.frames: list[tuple[int, bytes]] = []
        self.ages: list[float] = []

    def tearDown(self) -> None:
        for each in (self.publisher, self.viewer, self.a, self.b):
            each.stop()

    def see(self, sequence: int, frame: bytes, age: float) -> None:
        self.frames.append((sequence, frame))
        self.ages.append(age)

    def part(self, sequence: int, number: int, count: int, part: bytes, age_ms: int = 0) -> None:
        self.viewer._answer_part(self.to_publisher, CAMERA, sequence, number, count, part, age_ms)

    def test_frames_arrive_whole(self) -> None:
        """A frame of many fragments arrives unchanged at every viewer until the viewer stops; no timer is left."""
        others: list[int] = []
        stop = self.viewer.view(self.to_publisher, CAMERA, self.see)
        stop_other = self.viewer.view(self.to_publisher, CAMERA, lambda sequence, frame, age: others.append(sequence))
        self.clock.advance(0.1)
        frame = random.Random(1).randbytes(5 * PART_BYTES + 7)
        self.publisher.publish(CAMERA, 1, frame)
        self.clock.advance(0.1)
        stop()
        stop()
        self.publisher.publish(CAMERA, 2, b"x")
        self.clock.advance(0.1)
        stop_other()
        self.assertEqual((self.frames, others), ([(1, frame)], [1, 2]))
        self.viewer.view(self.to_publisher, CAMERA, self.see)
        self.clock.advance(0.1)
        self.tearDown()
        self.publisher.publish(CAMERA, 3, b"x")
        self.clock.advance(0.1)
        self.assertEqual(self.clock.getDelayedCalls(), [])

    def test_age_counts_from_the_camera(self) -> None:
        """The age of a frame is its age at sending plus its transfer time; this needs no synchronized clocks."""
        self.viewer.view(self.to_publisher, CAMERA, self.see)
        self.clock.advance(0.1)
        self.publisher.publish(CAMERA, 1, bytes(2 * PART_BYTES), 0.25)
        self.clock.advance(0.1)
        (age,) = self.ages
        self.assertLess(abs(age - 0.25 - DELAY), 0.0005)
        self.part(2, 0, 2, b"a", 500)
        self.clock.advance(0.3)
        self.part(2, 1, 2, b"b", 500)
        self.assertLess(abs(self.ages[1] - 0.8 - DELAY), 0.0005)

    def test_nothing_is_sent_unseen(self) -> None:
        """A publisher sends nothing without viewers, or soon after the last viewer left.

        It never sends an empty or oversized frame.
        """
        self.assertFalse(self.publisher.has_viewers(CAMERA))
        stop = self.viewer.view(self.to_publisher, CAMERA, self.see)
        self.clock.advance(10.0)
        self.assertTrue(self.publisher.has_viewers(CAMERA))
        for frame in (bytes(MAX_PARTS * PART_BYTES + 1), b""):
            self.publisher.publish(CAMERA, 1, frame)
        self.clock.advance(0.1)
        self.assertEqual(self.frames, [])
        stop()
        self.clock.advance(SUBSCRIPTION_TTL_S + 0.1)
        sent = self.switchboard.counters["sent"]
        self.publisher.publish(CAMERA, 1, b"x")
        self.assertEqual(self.switchboard.counters["sent"], sent)

    def test_lost_part_drops_the_frame(self) -> None:
        """A frame with a lost fragment is dropped; an older frame that arrives late is dropped, too.

        No frame is shown twice.
        """
        self.viewer.view(self.to_publisher, CAMERA, self.see)
        self.part(1, 0, 2, b"a")
        self.part(2, 1, 2, b"d")
        self.part(1, 1, 2, b"b")
        self.part(2, 0, 2, b"c")
        self.part(2, 0, 2, b"c")
        self.assertEqual(self.frames, [(2, b"cd")])

    def test_publisher_begins_anew(self) -> None:
        """If a camera starts its sequence numbers again, its frames are accepted after about a second."""
        self.viewer.view(self.to_publisher, CAMERA, self.see)
        self.part(500, 0, 1, b"old")
        self.part(1, 0, 1, b"too soon")
        self.clock.advance(1.1)
        self.part(2, 0, 1, b"new")
        self.part(3, 0, 1, b"newer")
        self.assertEqual([frame for _, frame in self.frames], [b"old", b"new", b"newer"])

    def test_crafted_parts(self) -> None:
        """Inconsistent, oversized or unexpected fragments are ignored without an exception."""
        self.viewer.view(self.to_publisher, CAMERA, self.see)
        self.part(1, 5, 6, b"x")
        self.part(1, 0, 2, b"x")
        for number, count in ((0, 0), (-1, 1), (1, 1), (0, MAX_PARTS + 1)):
            self.part(2, number, count, b"x")
        self.part(2, 0, 1, bytes(PART_BYTES + 1))
        for age_ms in (-1, 600_001, 2**70):
            self.part(2, 0, 1, b"x", age_ms)
        self.viewer._answer_part(self.to_viewer, CAMERA, 1, 0, 1, b"a stranger's")
        self.viewer._answer_part(self.to_publisher, "other", 1, 0, 1, b"x")
        self.assertEqual(self.frames, [])

    def test_viewers_are_bounded(self) -> None:
        """The number of viewers is limited.

        Existing viewers can renew, and a new viewer can replace an expired viewer.
        """
        peers = [Contact(bytes([n]) * 32, Address("10.0.0.1", 9)) for n in range(MAX_VIEWERS + 1)]
        for number, peer in enumerate(peers[:-1]):
            self.assertTrue(self.publisher._answer_open(peer, f"channel {number}"))
        self.assertRaises(Refused, self.publisher._answer_open, peers[-1], CAMERA)
        self.assertTrue(self.publisher._answer_open(peers[0], "channel 0"))
        self.assertRaises(Refused, self.publisher._answer_open, peers[0], "x" * 33)
        self.clock.advance(SUBSCRIPTION_TTL_S + 0.1)
        self.assertTrue(self.publisher._answer_open(peers[-1], CAMERA))
        self.assertTrue(self.publisher.has_viewers(CAMERA))
