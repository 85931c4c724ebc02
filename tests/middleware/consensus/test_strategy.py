"""Tests of the lookup of strategies by name, and of the validity of reports."""

from __future__ import annotations

import math
import sys
from dataclasses import replace
from typing import Any

from twisted.trial.unittest import SynchronousTestCase

from middleware.consensus.strategies.nearest import Nearest
from middleware.consensus.strategy import BUILT_IN, Report, digest_of, load_strategy, refusal, standing
from middleware.errors import UnknownStrategy


class Broken:
    """A strategy with a constructor that raises."""

    def __init__(self) -> None:
        raise ZeroDivisionError("broken")


class StrategyTests(SynchronousTestCase):
    def test_dotted_only_on_demand(self) -> None:
        """Only local settings may contain the name of a module to import; a task from a peer may not."""
        sys.modules.pop("this", None)
        self.assertRaises(UnknownStrategy, load_strategy, "this:s")
        self.assertNotIn("this", sys.modules)
        self.assertIsInstance(load_strategy("middleware.consensus.strategies.nearest:Nearest", dotted=True), Nearest)

    def test_what_cannot_be_loaded(self) -> None:
        """A missing module, a missing class, an empty name and a broken class raise ``UnknownStrategy``."""
        broken = f"{__name__}:Broken"
        for name in (
            "no.such:X",
            "middleware.consensus.strategies.nearest:No",
            ":X",
            ".x:Y",
            "math:",
            broken,
            "math:pi",
        ):
            self.assertRaises(UnknownStrategy, load_strategy, name, dotted=True)

    def test_refused_by_name(self) -> None:
        """Each invalid report is rejected with the reason."""
        rows = [
            ({"cost": math.nan}, "cost is not a number"),
            ({"cost": math.inf}, "cost is infinite"),
            ({"cost": -math.inf}, "cost is infinite"),
            ({"cost": -2.0}, "cost -2 is negative"),
            ({"cost": 1e12}, "cost 1e+12 exceeds 1e+09 in magnitude"),
            ({"cost": True}, "cost must be a number"),
            ({"cost": "1"}, "cost must be a number"),
            ({"cost": None}, "cost must be a number"),
            ({"cost": 10**5000}, "cost an integer with thousands of digits exceeds 1e+09 in magnitude"),
            ({"weight": -1.0}, "weight -1 is negative"),
            ({"electorate": math.inf}, "electorate is infinite"),
            ({"value": (0.0, math.nan)}, "value is not a number"),
            ({"value": (1e300,)}, "value 1e+300 exceeds 1e+09 in magnitude"),
            ({"value": [1.0]}, "value must be a tuple of at most 8 numbers"),
            ({"battery": 1.5}, "battery 1.5 is not between 0 and 1"),
            ({"epoch": -1}, "epoch, sequence or capacity -1 is not a whole number from 0 to 2^53 - 1"),
            ({"capacity": 2.0}, "epoch, sequence or capacity 2 is not a whole number from 0 to 2^53 - 1"),
            ({"choice": "x" * 999}, "task and choice must be strings of at most 200 characters"),
            ({"agent": ""}, "agent must be a string of 1 to 200 characters"),
            ({"unmet": ("has no camera", "has no gripper")}, "requirements not met: has no camera, has no gripper"),
            ({"age": 6.5, "valid_for": 5.0}, "stale: 6.5 s old, valid for 5 s"),
        ]
        for change, why in rows:
            bad = replace(Report("dog", 1.0), **change)  # type: ignore[arg-type]
            self.assertEqual(refusal(bad), why)
        for good in (Report("dog", 0.0, age=4.0, valid_for=5.0), Report("cat", 1, value=(-9.0,))):
            self.assertEqual(refusal(good), "")

    def test_newest_epoch_stands(self) -> None:
        """Bids of an earlier epoch do not count. If an agent has several bids in one epoch, the lowest bid counts."""
        old, first, later = Report("a", 0.0), Report("a", 5.0, epoch=2), Report("a", 4.0, epoch=2)
        other = Report("b", 9.0, epoch=2)
        self.assertEqual(standing([old, other, first, later]), (later, other))

    def test_what_counts_for_nothing_gives_way(self) -> None:
        """An agent with a valid report replaces a holder with an invalid report, for every strategy."""
        strategies = [load_strategy(name) for name in BUILT_IN]
        nonsense: list[Any] = [None, "1", True, [], -1.0, math.nan, math.inf, 1e300, 10**400, 10**5000]
        for cost in nonsense:
            for strategy in strategies:
                self.assertIs(strategy.improves(Report("a", cost), Report("b", 9e8), 0.5), True, strategy.name)
                self.assertIs(strategy.improves(Report("a", cost), Report("b", cost), 0.5), False, strategy.name)
        self.assertTrue(Nearest().improves(Report("a", 1.0, unmet=("has no camera",)), Report("b", 9.0), 0.1))

    def test_digest(self) -> None:
        """The digest does not depend on the order of the reports, but changes if a cost or an agent changes."""
        a, b, c = Report("a", 1.0), Report("a", 2.0), Report("b", 1.0)
        self.assertEqual(digest_of([a, b, c]), digest_of([c, b, a]))
        self.assertEqual(len({digest_of(each) for each in ([a, c], [b, c], [a], [])}), 4)
