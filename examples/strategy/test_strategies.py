"""Conformance tests of the example strategies."""

from __future__ import annotations

from spare import Spare
from template import Farthest
from twisted.trial.unittest import SynchronousTestCase

from middleware.consensus.conformance import Conformance
from middleware.consensus.strategy import Report


class FarthestTests(Conformance, SynchronousTestCase):
    """The template passes the conformance tests."""

    make = Farthest


class SpareTests(Conformance, SynchronousTestCase):
    """The example passes the conformance tests, and selects by battery."""

    make = Spare

    def test_battery_decides(self) -> None:
        """Of two robots at about the same distance the robot with the fuller battery is selected."""
        near, full = Report("a", 41.0, battery=0.3), Report("b", 48.0, battery=0.9)
        self.assertEqual(Spare().find([near, full]).assigned_agent, "b")
