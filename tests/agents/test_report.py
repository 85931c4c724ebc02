"""Tests of ``agents.report``: the values that an agent reports in addition to its cost."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from twisted.trial.unittest import SynchronousTestCase

from agents.report import MIN_REPORT_INTERVAL_S, ReportBuilder
from drivers.reading import Observation
from middleware.consensus.strategy import READABLE
from middleware.entangled.clock import HeapClock
from middleware.tasks.task import Member

ME = Member("a", "dog", "WAITING")


class Minded:
    """A behaviour that reports a value, a choice and a weight."""

    cost: float | None = 2.0
    value: object = (1.0, 2)
    choice: object = "red"
    weight: object = 3
    electorate: object = 9.0


class ReporterTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.clock = HeapClock()
        self.minded = self.made()
        self.reporter = ReportBuilder(self.minded, READABLE)
        self.me = ME

    def made(self) -> Any:
        """Return a behaviour for the test to change."""
        return Minded()

    def news(self, charge: float = 0.8, load: int = 2) -> dict[str, Any]:
        """Return the values that changed since the previous report, and mark them as reported."""
        seen = Observation(0.0, 0.0, {"power.level": charge})
        self.reporter.load = load
        changes = self.reporter.find_changes(self.me, False, seen, self.clock.seconds()) or {}
        self.me = replace(self.me, **changes)
        return changes

    def test_all_is_told_at_first(self) -> None:
        """The first report with a cost contains battery, load and the behaviour's values.

        Later reports contain only the changes.
        """
        offer = {"value": (1.0, 2.0), "choice": "red", "weight": 3.0, "electorate": 9.0}
        self.assertEqual(self.news(), {"cost": 2.0, "available": True, "battery": 0.8, "load": 2, **offer})
        self.clock.advance(9.0)
        self.assertEqual(self.news(), {})

    def test_without_cost_nothing_is_offered(self) -> None:
        """An agent without a cost reports neither a vote nor a value."""
        self.minded.cost = None
        self.assertEqual(self.news(), {})

    def test_battery_is_told_in_steps(self) -> None:
        """The battery charge is reported in steps of a twentieth, clipped to the range 0 to 1."""
        self.news()
        self.assertEqual([self.news(charge) for charge in (0.79, 0.76)], [{}, {}])
        self.assertEqual(
            [self.news(charge) for charge in (0.75, -3.0, 7.0)], [{"battery": b} for b in (0.75, 0.0, 1.0)]
        )
        self.assertEqual(self.news(float("nan")), {})

    def test_votes_at_once_and_numbers_at_leisure(self) -> None:
        """A changed vote is reported immediately, a changed number at most once per second."""
        self.news()
        self.minded.choice, self.minded.value = "blue", (1.1, 2.0)
        self.assertEqual(self.news(), {"choice": "blue"})
        self.clock.advance(MIN_REPORT_INTERVAL_S)
        self.assertEqual(self.news(), {"value": (1.1, 2.0)})
        self.minded.value = ()
        self.assertEqual(self.news(), {"value": ()})

    def test_offers_that_are_none(self) -> None:
        """Invalid values, choices and weights of a behaviour are not reported."""
        bad: dict[str, list[object]] = {
            "value": [5, [1.0], ("x",), (float("nan"),), (1e12,), (0.0,) * 9],
            "choice": [None, 7, "x" * 65, "a\nb"],
            "weight": [-1.0, "2", float("inf")],
            "electorate": [None, -0.1],
        }
        self.minded.value, self.minded.choice, self.minded.weight, self.minded.electorate = (), "", 1.0, 0.0
        self.news()
        for name, values in bad.items():
            for value in values:
                setattr(self.minded, name, value)
                self.clock.advance(MIN_REPORT_INTERVAL_S)
                self.assertEqual(self.news(), {}, (name, value))
