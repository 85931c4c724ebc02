"""Tests of the link emulation between namespaces, with a given random generator and given times."""

from __future__ import annotations

import statistics
from random import Random

from twisted.trial.unittest import SynchronousTestCase

from sim.namespaces.impairment import Impairments, LinkDirection

MANY = 20_000


def line(**figures: float) -> LinkDirection:
    """Return a link with these impairments."""
    made = LinkDirection(Random(7))
    made.impairments = Impairments(**figures)
    return made


class LinkDirectionTests(SynchronousTestCase):
    def test_losses_are_as_many_as_said(self) -> None:
        """The measured loss matches a configured loss of 10, 33 and 100 percent; the counters match the frames."""
        for percent in (10.0, 33.0, 100.0):
            lossy = line(loss=percent)
            lost = sum(not lossy.draw_delivery_times(100, 0.0) for _ in range(MANY))
            self.assertApproximates(100 * lost / MANY, percent, 1.5)
            self.assertEqual((lossy.lost, lossy.passed), (lost, MANY - lost))

    def test_losses_come_in_bursts(self) -> None:
        """With a burst length of five the loss rate is the same, and on average five consecutive frames are lost."""
        bursty = line(loss=20.0, burst=5.0)
        fates = [not bursty.draw_delivery_times(100, 0.0) for _ in range(MANY)]
        self.assertApproximates(sum(fates) / MANY, 0.2, 0.03)
        begun = sum(lost and not before for before, lost in zip([False, *fates], fates, strict=False))
        self.assertApproximates(sum(fates) / begun, 5.0, 0.6)

    def test_delay_and_jitter(self) -> None:
        """Mean and standard deviation of the delay match the settings; no frame arrives early."""
        slow = line(delay=50.0, jitter=10.0)
        late = [1000 * (slow.draw_delivery_times(100, 2.0)[0] - 2.0) for _ in range(MANY)]
        self.assertApproximates(statistics.mean(late), 50.0, 0.5)
        self.assertApproximates(statistics.stdev(late), 10.0, 0.5)
        self.assertGreaterEqual(min(late), 0.0)

    def test_a_narrow_line_queues_and_overflows(self) -> None:
        """At 80 kbit/s frames of 1000 bytes leave every 0.1 s; frames beyond the queue limit are dropped."""
        narrow = line(rate=80.0, queue=250.0)
        fates = [narrow.draw_delivery_times(1000, 0.0) for _ in range(5)]
        self.assertEqual([round(fate[0], 3) for fate in fates if fate], [0.1, 0.2, 0.3])
        self.assertEqual(narrow.lost, 2)

    def test_doubles_reordered_and_corrupt_frames(self) -> None:
        """Frames are duplicated, reordered, or corrupted by one bit after the header, but only if configured."""
        fair = line()
        self.assertEqual((fair.draw_delivery_times(100, 3.0), fair.corrupt_frame(b"frame", 0)), ([3.0], b"frame"))
        self.assertEqual(fair.counts, {"passed": 1, "lost": 0, "bytes": 100})
        self.assertEqual(line(dup=100.0).draw_delivery_times(100, 1.0), [1.0, 1.0])
        self.assertEqual(line(delay=50.0, reorder=100.0).draw_delivery_times(100, 1.0), [1.0])
        spoiled = line(corrupt=100.0).corrupt_frame(bytes(40), 34)
        self.assertEqual(spoiled[:34], bytes(34))
        self.assertEqual(sum(byte.bit_count() for byte in spoiled), 1)

    def test_senseless_weather_is_refused(self) -> None:
        """Percentages above 100, negative delays, bursts shorter than one frame and NaN are rejected."""
        for figures in ({"loss": 101.0}, {"delay": -1.0}, {"burst": 0.5}, {"rate": float("nan")}):
            self.assertRaises(ValueError, Impairments, **figures)
