"""Tests of metrics: their bounds, statistics and tables."""

from __future__ import annotations

import math

from twisted.trial.unittest import SynchronousTestCase

from sim.team.metric import (
    Bound,
    Metric,
    format_table,
    make_maximum,
    make_minimum,
    make_percentiles,
    make_share,
    mean,
    parse_bound,
    percentile,
)


class MetricTests(SynchronousTestCase):
    def test_bounds(self) -> None:
        """A bound is parsed from text; a value equal to its limit meets the bound, and invalid text is rejected."""
        self.assertEqual(parse_bound("<= 450"), Bound(450.0))
        self.assertTrue(parse_bound(">= 0.999").is_met(0.999))
        self.assertFalse(parse_bound(">= 0.999").is_met(0.9989))
        self.assertFalse(parse_bound("<= 450").is_met(math.nan))
        for text in ("450", "< 450", "<= many", "<= inf", ""):
            with self.assertRaises(ValueError):
                parse_bound(text)

    def test_what_was_not_measured_is_missed(self) -> None:
        """A figure without a value misses its target; a figure without a target has no result."""
        self.assertIs(make_maximum("x", None, "s", 1.0).holds, False)
        self.assertIs(make_minimum("x", 2.0, "s", 1.0).holds, True)
        self.assertIsNone(Metric("x", None).holds)

    def test_percentiles(self) -> None:
        """A percentile is a measured value: the smallest one that the given share of the values does not exceed."""
        values = [float(n) for n in range(100, 0, -1)]
        self.assertEqual((percentile(values, 0.5), percentile(values, 0.99)), (50.0, 99.0))
        self.assertEqual([figure.value for figure in make_percentiles("x", values, "s")], [50.0, 99.0, 100.0])
        self.assertIsNone(percentile([], 0.5))
        self.assertIsNone(mean([]))

    def test_table(self) -> None:
        """The table shows missed targets; for a share without failures it shows the upper confidence limit."""
        shown = format_table(
            [
                make_share("found", 1000, 1000).with_target(Bound(0.999, is_maximum=False)),
                make_maximum("slow", 3.0, "s", 2.0),
            ]
        )
        self.assertIn("n 1,000, < 0.003 else", shown)
        self.assertRegex(shown, r"found +1 share +>= 0\.999 +yes")
        self.assertRegex(shown, r"slow +3 s +<= 2 +NO")

    def test_json_knows_no_infinity(self) -> None:
        """An infinite value is packed as None, because JSON has no infinity."""
        self.assertIsNone(Metric("x", math.inf, "s").to_json()["value"])
        self.assertEqual(Metric("x", 1.5, "s").to_json()["value"], 1.5)
