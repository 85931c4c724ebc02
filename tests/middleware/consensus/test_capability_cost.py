"""Tests of the choice among devices with different capabilities."""

from __future__ import annotations

import math
from dataclasses import replace

from hypothesis import given, settings
from hypothesis import strategies as st
from twisted.trial.unittest import SynchronousTestCase

from middleware.consensus.strategies.capability_cost import CapabilityCost
from middleware.consensus.strategy import Report

shares = st.floats(0.0, 1.0)
seconds = st.floats(0.0, 1e6)


class CapabilityCostTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.strategy = CapabilityCost()

    def test_the_incapable_never_win(self) -> None:
        """A device with an unmet requirement does not win, whatever the costs."""
        for cost in (0.0, math.nan, math.inf, -1.0):
            unable = Report("dog1", cost, unmet=("has no camera",))
            found = self.strategy.find([unable, Report("dog2", 9e8)])
            self.assertEqual((found.assigned_agent, found.standby), ("dog2", ()))
            self.assertEqual(self.strategy.find([unable]).assigned_agent, None)
            self.assertFalse(self.strategy.improves(Report("dog2", 9e8), unable, 0.0))

    @settings(max_examples=100)
    @given(seconds, shares, st.integers(0, 9), seconds, shares, st.integers(1, 9))
    def test_monotone(self, way: float, battery: float, load: int, more: float, less: float, tasks: int) -> None:
        """A greater distance, a lower battery level or more tasks never make the weight of a report lower."""
        report = Report("a", way, battery=battery, load=float(load))
        weight = self.strategy.weigh(report)
        self.assertGreaterEqual(self.strategy.weigh(replace(report, cost=way + more)), weight)
        self.assertGreaterEqual(self.strategy.weigh(replace(report, battery=battery * less)), weight)
        self.assertGreater(self.strategy.weigh(replace(report, load=float(load + tasks))), weight)

    def test_terms(self) -> None:
        """At equal distances the device with the fuller battery wins.

        At equal batteries the device with fewer tasks wins.
        """
        tired, fresh, busy = Report("a", 5.0, battery=0.2), Report("b", 5.0), Report("c", 5.0, load=2.0)
        found = self.strategy.find([tired, fresh, busy])
        self.assertEqual((found.assigned_agent, found.standby), ("b", ("a", "c")))

    def test_own_reports(self) -> None:
        """Of two reports of one device, the one with the lower weight counts, even if its distance is longer."""
        tired, fresh = Report("a", 5.0, battery=0.2), Report("a", 6.0)
        self.assertEqual(self.strategy.merge([tired], [fresh]), (fresh,))
        self.assertEqual(self.strategy.find([tired, fresh, Report("b", 10.0)]).assigned_agent, "a")
