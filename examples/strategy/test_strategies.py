"""Conformance tests of the example strategies."""

from __future__ import annotations

from spare import Spare
from template import Farthest
from twisted.trial.unittest import SynchronousTestCase

from middleware.consensus.conformance import Conformance
from middleware.consensus.strategy import Report


class FarthestTests(Conformance, SynchronousTestCase):
    """The template conforms."""

    make = Farthest


class SpareTests(Conformance, SynchronousTestCase):
    """The example conforms, and the battery decides."""

    make = Spare

    def test_battery_decides(self) -> None:
        """Of two that are about as near the one with the fuller battery goes."""
        near, full = Report("a", 41.0, battery=0.3), Report("b", 48.0, battery=0.9)
        self.assertEqual(Spare().find([near, full]).assigned_agent, "b")
