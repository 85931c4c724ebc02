"""Tests of background work."""

from __future__ import annotations

from twisted.internet.defer import Deferred, fail
from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.background import Background, gather_first
from middleware.entangled.clock import HeapClock
from middleware.entangled.errors import NoAnswer, Refused


async def wait(deferred: Deferred[int]) -> int:
    return await deferred


class BackgroundTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.clock = HeapClock()
        self.background = Background(self.clock)
        self.runs: list[object] = []

    def test_later_and_cancel(self) -> None:
        """A delayed call runs once with its arguments unless it is cancelled; a late cancel has no effect."""
        prevent = self.background.later(1.0, self.runs.append, "a")
        self.background.later(1.0, self.runs.append, "b")()
        self.clock.advance(2.0)
        prevent()
        self.assertEqual(self.runs, ["a"])

    def test_every_survives_an_accident(self) -> None:
        """A periodic call that raises an error is called again at the next interval."""

        def work() -> None:
            self.runs.append(1)
            if len(self.runs) == 1:
                raise ZeroDivisionError

        self.background.every(1.0, work)
        self.assertRaises(ZeroDivisionError, self.clock.advance, 1.0)
        self.clock.advance(2.0)
        self.assertEqual(len(self.runs), 3)

    def test_stop_leaves_nothing(self) -> None:
        """``sleep`` ends on time.

        After ``stop`` no timer is left, no new call is scheduled and a pending ``sleep`` never ends.
        """
        self.background.every(2.0, lambda: self.runs.append(1))
        sleep = self.background.sleep(1.0)
        self.clock.advance(0.9)
        self.assertNoResult(sleep)
        self.clock.advance(0.2)
        self.successResultOf(sleep)
        sleep = self.background.sleep(1.0)

        self.background.stop()
        self.background.later(1.0, self.runs.append, 1)
        self.assertEqual(self.clock.getDelayedCalls(), [])
        self.clock.advance(3.0)
        self.assertNoResult(sleep)
        self.assertEqual(self.runs, [])

    def test_fork_hears_only_accidents(self) -> None:
        """``fork`` ignores network errors and rejections, and logs any other error."""
        for error in (NoAnswer("x"), Refused("x"), ZeroDivisionError()):
            self.background.fork(wait(fail(error)))
        self.assertEqual(len(self.flushLoggedErrors()), 1)


class FirstTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.asked: list[Deferred[int]] = [Deferred() for _ in range(3)]

    def begin(self, needed: int) -> Deferred[list[int]]:
        return Deferred.fromCoroutine(gather_first(needed, [wait(d) for d in self.asked]))

    def test_enough(self) -> None:
        """``first`` returns the required number of results in the order of arrival, and ignores later results."""
        result = self.begin(2)
        self.asked[2].callback(2)
        self.assertNoResult(result)
        self.asked[0].callback(0)
        results = self.successResultOf(result)
        self.asked[1].callback(1)
        self.assertEqual(results, [2, 0])

    def test_too_few(self) -> None:
        """If too many calls fail, ``first`` returns the results of the successful calls.

        Without calls it returns immediately.
        """
        result = self.begin(3)
        self.asked[0].errback(NoAnswer("x"))
        self.asked[1].callback(1)
        self.assertNoResult(result)
        self.asked[2].errback(Refused("x"))
        self.assertEqual(self.successResultOf(result), [1])
        for needed, work in ((0, [wait(Deferred())]), (2, [])):
            self.assertEqual(self.successResultOf(Deferred.fromCoroutine(gather_first(needed, work))), [])
