"""Tests of figures: their bounds, statistics and tables."""

from __future__ import annotations

import math

from twisted.trial.unittest import SynchronousTestCase

from sim.team.figure import Bound, Figure, at_least, at_most, bound_of, mean, percentile, share, spread, table


class FigureTests(SynchronousTestCase):
    def test_bounds(self) -> None:
        """A bound is parsed from text and includes its limit; invalid text is rejected."""
        self.assertEqual(bound_of("<= 450"), Bound(450.0))
        self.assertTrue(bound_of(">= 0.999").holds(0.999))
        self.assertFalse(bound_of(">= 0.999").holds(0.9989))
        self.assertFalse(bound_of("<= 450").holds(math.nan))
        for text in ("450", "< 450", "<= many", "<= inf", ""):
            with self.assertRaises(ValueError):
                bound_of(text)

    def test_what_was_not_measured_is_missed(self) -> None:
        """A figure without a value misses its target; a figure without a target has no result."""
        self.assertIs(at_most("x", None, "s", 1.0).holds, False)
        self.assertIs(at_least("x", 2.0, "s", 1.0).holds, True)
        self.assertIsNone(Figure("x", None).holds)

    def test_percentiles(self) -> None:
        """A percentile is one of the values, the smallest that covers the share."""
        values = [float(n) for n in range(100, 0, -1)]
        self.assertEqual((percentile(values, 0.5), percentile(values, 0.99)), (50.0, 99.0))
        self.assertEqual([figure.value for figure in spread("x", values, "s")], [50.0, 99.0, 100.0])
        self.assertIsNone(percentile([], 0.5))
        self.assertIsNone(mean([]))

    def test_table(self) -> None:
        """The table shows missed targets, and the upper confidence limit of a share without failures."""
        shown = table([share("found", 1000, 1000).against(Bound(0.999, most=False)), at_most("slow", 3.0, "s", 2.0)])
        self.assertIn("n 1,000, < 0.003 else", shown)
        self.assertRegex(shown, r"found +1 share +>= 0\.999 +yes")
        self.assertRegex(shown, r"slow +3 s +<= 2 +NO")

    def test_json_knows_no_infinity(self) -> None:
        """An infinite value is packed as None, because JSON has no infinity."""
        self.assertIsNone(Figure("x", math.inf, "s").packed()["value"])
        self.assertEqual(Figure("x", 1.5, "s").packed()["value"], 1.5)
