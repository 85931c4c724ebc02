"""Tests of the limits that a guard imposes on a faulty strategy."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

from twisted.trial.unittest import SynchronousTestCase

from middleware.consensus.assignment import Item
from middleware.consensus.deployed_modules import Factory
from middleware.consensus.guarded_strategy import LOSS_SPAN_CALLS, MAX_LOSSES, GuardedStrategy, StrategyLost
from middleware.consensus.strategies.cbba import Cbba
from middleware.consensus.strategies.nearest import Nearest
from middleware.consensus.strategy import Consensus, Report
from middleware.consensus.strategy_registry import StrategyRegistry, load_guarded_strategy
from middleware.errors import UnknownStrategy

TEAM = [Report("a", 3.0), Report("b", 1.0), Report("c", 2.0)]


class Raising(Nearest):
    """Raises in every method."""

    name = "raising"

    def find(self, contacts: Sequence[Report]) -> Consensus:
        raise ZeroDivisionError("I divide")

    def improves(self, current: Report, offer: Report, hysteresis: float) -> bool:
        raise KeyError("nothing")

    def merge(self, a: Sequence[Report], b: Sequence[Report]) -> tuple[Report, ...]:
        raise RecursionError("deep")


class Lying(Nearest):
    """Returns the given result in every method."""

    name = "lying"

    def __init__(self, answer: object) -> None:
        self.answer = answer

    def find(self, contacts: Sequence[Report]) -> Consensus:
        return self.answer  # type: ignore[return-value]


class Moody(Nearest):
    """Chooses the nearest and the farthest agent alternately."""

    name = "moody"
    asked = 0

    def find(self, contacts: Sequence[Report]) -> Consensus:
        found = super().find(contacts)
        self.asked += 1
        if self.asked % 2 or not found.standby:
            return found
        return Consensus(found.standby[-1], (), found.digest)


class OrderBound(Nearest):
    """Chooses the first report, so the result depends on the order of the reports."""

    name = "order_bound"

    def find(self, contacts: Sequence[Report]) -> Consensus:
        return Consensus(contacts[0].agent)


class Slow(Nearest):
    """Exceeds the timeout in every call."""

    name = "slow"
    asked = 0

    def find(self, contacts: Sequence[Report]) -> Consensus:
        self.asked += 1
        raise StrategyLost("it did not answer in time")


class Moments(Nearest):
    """Exceeds the timeout in the ``pause``-th call and in each multiple of it."""

    name = "moments"
    asked = 0

    def __init__(self, pause: int) -> None:
        self.pause = pause

    def improves(self, current: Report, offer: Report, hysteresis: float) -> bool:
        self.asked += 1
        if self.asked % self.pause == 0:
            raise StrategyLost("it did not answer in time")
        return super().improves(current, offer, hysteresis)


class Inventing(Nearest):
    """Adds a report to each summary, and returns a string from ``improves``."""

    name = "inventing"

    def merge(self, a: Sequence[Report], b: Sequence[Report]) -> tuple[Report, ...]:
        return (Report("nobody", 0.0),)

    def improves(self, current: Report, offer: Report, hysteresis: float) -> bool:
        return "perhaps"  # type: ignore[return-value]


class GuardedStrategyTests(SynchronousTestCase):
    def assert_falls_back(self, guarded: GuardedStrategy, why: str) -> None:
        """Check that the nearest agent wins, that the reason contains ``words``, and that an error is logged."""
        found = guarded.find(TEAM)
        self.assertEqual((found.assigned_agent, found.standby), ("b", ("c", "a")))
        self.assertEqual(found.strategy, "nearest")
        self.assertIn(f"{guarded.name} failed (", found.reason)
        self.assertIn(why, found.reason)
        guarded.find(TEAM)
        self.assertTrue(self.flushLoggedErrors())

    def test_raising(self) -> None:
        """A strategy that raises is replaced by ``Nearest``.

        The reason contains the exception, which is logged once.
        """
        guarded = GuardedStrategy(Raising())
        found = guarded.find(TEAM)
        self.assertEqual(found.assigned_agent, "b")
        self.assertEqual(
            found.reason, "raising failed (ZeroDivisionError: I divide); nearest: cost 1.00, the lowest of 3"
        )
        guarded.find(TEAM)
        logged = self.flushLoggedErrors(ZeroDivisionError)
        self.assertEqual(len(logged), 1)
        self.assertIn("in find", logged[0].getTraceback())

    def test_raising_elsewhere(self) -> None:
        """``improves`` and ``merge`` of a strategy that raises also fall back to ``Nearest``."""
        guarded = GuardedStrategy(Raising())
        self.assertTrue(guarded.improves(TEAM[0], TEAM[1], 0.1))
        self.assertFalse(guarded.improves(TEAM[1], TEAM[0], 0.1))
        self.assertEqual(guarded.merge(TEAM, TEAM), Nearest().merge(TEAM, ()))
        self.assertEqual(len(self.flushLoggedErrors()), 2)

    def test_lying(self) -> None:
        """A result is rejected if it has unknown, repeated or too many agents, too long strings or a wrong type."""
        for lie, why in (
            (Consensus("zorro"), "which did not report"),
            (Consensus("b", ("zorro",)), "which did not report"),
            (Consensus("b", assigned=("zorro",)), "which did not report"),
            (Consensus("b", ("b",)), "twice"),
            (Consensus("b", ("a",) * 1_000_000), "too many agents or numbers"),
            (Consensus("b", reason="x" * 10_000_000), "too long"),
            (Consensus("b", value=(math.nan,)), "not a tuple of valid numbers"),
            (Consensus(["b"]), "TypeError"),  # type: ignore[arg-type]
            ("b", "str"),
            (None, "NoneType"),
        ):
            self.assert_falls_back(GuardedStrategy(Lying(lie)), why)

    def test_mutable_state(self) -> None:
        """If a strategy gives different results for equal reports, this is detected in the same or the next call."""
        self.assert_falls_back(GuardedStrategy(Moody(), twice=True), "different results")
        later = GuardedStrategy(Moody())
        self.assertEqual(later.find(TEAM).assigned_agent, "b")
        self.assertIn("different results", later.find(TEAM).reason)
        self.flushLoggedErrors()

    def test_order(self) -> None:
        """The guard detects a strategy that depends on the order of reports, or passes the reports in a fixed order."""
        self.assert_falls_back(GuardedStrategy(OrderBound(), twice=True), "different results")
        self.assertEqual(GuardedStrategy(OrderBound()).find(TEAM), GuardedStrategy(OrderBound()).find(TEAM[::-1]))

    def test_late(self) -> None:
        """A strategy that exceeds the timeout ``MAX_LOSSES`` times is not called again."""
        slow = Slow()
        guarded = GuardedStrategy(slow)
        for _ in range(10):
            self.assertEqual(guarded.find(TEAM).assigned_agent, "b")
        self.assertEqual(slow.asked, MAX_LOSSES)
        self.assertIn("not called again", guarded.find(TEAM).reason)
        self.flushLoggedErrors()

    def test_late_now_and_then(self) -> None:
        """A strategy stays in use with fewer than ``MAX_LOSSES`` timeouts in ``LOSS_SPAN_CALLS`` calls."""
        for pause, is_out in (
            (LOSS_SPAN_CALLS // (MAX_LOSSES - 1), False),
            (LOSS_SPAN_CALLS // (MAX_LOSSES - 1) - 1, True),
        ):
            moments = Moments(pause)
            guarded = GuardedStrategy(moments)
            for _ in range(10 * LOSS_SPAN_CALLS):
                guarded.improves(TEAM[0], TEAM[1], 0.1)
            self.assertEqual(moments.asked < 10 * LOSS_SPAN_CALLS, is_out, pause)
            self.assertEqual(guarded.find(TEAM).strategy, "nearest" if is_out else "moments")
        self.flushLoggedErrors()

    def test_inventing(self) -> None:
        """A summary with unknown reports, and a result of ``improves`` that is not a bool, are rejected."""
        guarded = GuardedStrategy(Inventing())
        self.assertEqual(guarded.merge(TEAM, ()), Nearest().merge(TEAM, ()))
        self.assertTrue(guarded.improves(TEAM[0], TEAM[1], 0.1))
        self.assertEqual(len(self.flushLoggedErrors()), 2)

    def test_group(self) -> None:
        """A valid group result is kept; if it omits a task or exceeds a capacity, ``Nearest`` decides."""
        items = [Item("s"), Item("t")]
        bids = [Report(a, c, task=t) for a, c in (("a", 1.0), ("b", 2.0)) for t in "st"]
        good = Cbba().find_group(bids, items)
        self.assertEqual(GuardedStrategy(Cbba()).find_group(bids, items), good)
        self.assertEqual([p.assigned_agent for p in GuardedStrategy(Nearest()).find_group(bids, items)], ["a", "b"])

        class Bad(Cbba):
            answer: object = ()

            def find_group(self, contacts: Sequence[Report], items: Sequence[Item]) -> tuple[Consensus, ...]:
                return self.answer  # type: ignore[return-value]

        for answer, why in (
            (good[:1], "one decision for each task"),
            (good[::-1], "one decision for each task"),
            ((good[0], replace(good[0], task="t")), "to 'a' more tasks than its capacity"),
            ((good[0], replace(good[1], assigned_agent="zorro")), "which did not report"),
            (("s", "t"), "not return a tuple of Consensus"),
            (None, "not return a tuple of Consensus"),
        ):
            bad = Bad()
            bad.answer = answer
            found = GuardedStrategy(bad).find_group(bids, items)
            self.assertEqual([p.assigned_agent for p in found], ["a", "b"])
            self.assertIn(why, found[0].reason)
            self.flushLoggedErrors()

    def test_unlawful_reports_never_reach_it(self) -> None:
        """A guard passes only valid reports to its strategy."""
        bad = [Report("x", cost) for cost in (math.nan, math.inf, -1.0, 1e300)]
        bad += [Report("x", 0.0, age=3.0, valid_for=2.0), Report("x", 0.0, unmet=("has no camera",))]
        guarded = GuardedStrategy(Nearest())
        self.assertEqual(guarded.find([*bad, *TEAM]), guarded.find(TEAM))
        for offer in bad:
            self.assertFalse(GuardedStrategy(Lying(None)).improves(TEAM[0], offer, 0.0))

    def test_by_name(self) -> None:
        """Built-in strategies that are loaded by name have a guard; an unknown name raises an error."""
        self.assertIsInstance(load_guarded_strategy("nearest").strategy, Nearest)
        error = self.assertRaises(UnknownStrategy, load_guarded_strategy, "farthest")
        self.assertIn("nearest", str(error))
        self.assertRaises(UnknownStrategy, load_guarded_strategy, "this:s")


class StrategiesTests(SynchronousTestCase):
    def test_built_in(self) -> None:
        """Each task gets a new instance of a built-in strategy, also after ``stop``.

        An unknown name raises an error.
        """
        strategies = StrategyRegistry()
        first, second = strategies.get("nearest", {}), strategies.get("nearest", {})
        self.assertIsInstance(first.strategy, Nearest)
        self.assertIsNot(first, second)
        strategies.stop()
        self.assertIsInstance(strategies.get("cbba", {}).strategy, Cbba)
        self.assertRaises(UnknownStrategy, strategies.get, "farthest", {})

    def test_deployed(self) -> None:
        """A new task gets the version that was deployed last; an earlier task keeps its version."""
        deployed: dict[tuple[str, str], Factory] = {("strategy", "best"): Nearest}
        strategies = StrategyRegistry()
        before = strategies.get("deployed:best", deployed)
        deployed["strategy", "best"] = Cbba
        self.assertIsInstance(strategies.get("deployed:best", deployed).strategy, Cbba)
        self.assertIsInstance(before.strategy, Nearest)
        self.assertRaises(UnknownStrategy, strategies.get, "deployed:best", {})
