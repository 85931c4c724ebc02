"""Tests of the simulated clock."""

from __future__ import annotations

import random
import time

from twisted.internet.base import ReactorBase
from twisted.internet.error import AlreadyCalled, AlreadyCancelled
from twisted.internet.interfaces import IDelayedCall, IReactorTime
from twisted.trial.unittest import SynchronousTestCase
from zope.interface.verify import verifyObject

from middleware.entangled.clock import HeapClock, find_boot_clock, use_monotonic_time


class HeapClockTests(SynchronousTestCase):
    def setUp(self) -> None:
        """Create a clock and a list that records the calls."""
        self.clock = HeapClock()
        self.called: list[object] = []

    def test_provides_interfaces(self) -> None:
        """The clock and its calls implement Twisted's interfaces; a negative delay raises ``ValueError``."""
        self.assertRaises(ValueError, self.clock.callLater, -1, self.called.append, 1)

        self.assertTrue(verifyObject(IReactorTime, self.clock))
        self.assertTrue(verifyObject(IDelayedCall, self.clock.callLater(1, self.called.append, 1)))

    def test_call_sees_its_own_moment(self) -> None:
        """A call runs at its scheduled time; calls that it schedules run in the same advance."""

        def again() -> None:
            self.called.append(self.clock.seconds())
            if len(self.called) < 3:
                self.clock.callLater(0.25, again)

        self.clock.callLater(0.25, again)
        self.clock.run_until(10.0)
        self.assertEqual(self.called, [0.25, 0.5, 0.75])
        self.assertEqual(self.clock.seconds(), 10.0)

    def test_cancel_reset_delay(self) -> None:
        """A cancelled call never runs; a rescheduled call runs once, at its new time."""
        gone = self.clock.callLater(1, self.called.append, "gone")
        later = self.clock.callLater(1, self.called.append, "later")
        sooner = self.clock.callLater(5, self.called.append, "sooner")
        gone.cancel()
        later.delay(2)
        sooner.reset(2)
        self.assertEqual(self.clock.getDelayedCalls(), [sooner, later])
        self.clock.pump([2, 0.5])
        self.assertEqual(self.called, ["sooner"])
        self.clock.advance(10)
        self.assertEqual(self.called, ["sooner", "later"])
        self.assertFalse(later.active())
        self.assertRaises(AlreadyCalled, later.cancel)
        self.assertRaises(AlreadyCancelled, gone.reset, 1)
        self.assertEqual(self.clock.getDelayedCalls(), [])

    def test_exception_passes(self) -> None:
        """An exception in a call reaches the caller of ``advance``, and the clock stops at that call."""
        self.clock.callLater(1, int, "x")
        self.clock.callLater(2, self.called.append, "next")
        self.assertRaises(ValueError, self.clock.advance, 5)
        self.assertEqual(self.clock.seconds(), 1)
        self.clock.advance(1)
        self.assertEqual(self.called, ["next"])

    def test_agrees_with_a_sorted_list(self) -> None:
        """If calls are scheduled, rescheduled and cancelled at random, they run in the order of their times."""
        rng = random.Random(7)
        expected: dict[int, tuple[float, int]] = {}
        calls = []
        order = 0
        for number in range(2000):
            delay = rng.randrange(100) / 4
            calls.append(self.clock.callLater(delay, self.called.append, number))
            expected[number] = (delay, order := order + 1)
            victim = rng.randrange(len(calls))
            if calls[victim].active():
                if rng.random() < 0.6:
                    calls[victim].cancel()
                    del expected[victim]
                elif rng.random() < 0.5:
                    delay = rng.randrange(100) / 4
                    calls[victim].reset(delay)
                    expected[victim] = (delay, order := order + 1)
        self.clock.advance(30)
        self.assertEqual(self.called, sorted(expected, key=lambda number: expected[number]))

    def test_cancelled_calls_leave_the_heap(self) -> None:
        """Cancelled calls are removed from the heap."""
        for _ in range(100_000):
            self.clock.callLater(60, self.called.append, 1).cancel()
        self.assertLess(len(self.clock._heap), 200)


class MonotonicTests(SynchronousTestCase):
    def test_reactors_run_on_boot_time(self) -> None:
        """After ``use_monotonic_time`` every reactor uses the boot-time clock; a second call has no effect."""
        self.patch(ReactorBase, "seconds", ReactorBase.__dict__["seconds"])
        use_monotonic_time()
        use_monotonic_time()
        before = find_boot_clock()()
        self.assertLessEqual(before, ReactorBase.seconds())
        self.assertLess(ReactorBase.seconds(), before + 1.0)
        if hasattr(time, "CLOCK_BOOTTIME"):  # CLOCK_BOOTTIME also advances while the system is suspended
            self.assertAlmostEqual(find_boot_clock()(), time.clock_gettime(time.CLOCK_BOOTTIME), 1)

    def test_leap(self) -> None:
        """After a suspension each overdue call runs once, at the new time."""
        clock = HeapClock()
        called: list[float] = []
        clock.callLater(1.0, lambda: called.append(clock.seconds()))
        clock.suspend(60.0)
        self.assertEqual((clock.seconds(), called), (60.0, []))
        clock.advance(0.5)
        self.assertEqual(called, [60.0])
