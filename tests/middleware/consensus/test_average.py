"""Tests of averages and meeting points."""

from __future__ import annotations

import math
import random
from itertools import combinations

from hypothesis import given, settings
from hypothesis import strategies as st
from twisted.trial.unittest import SynchronousTestCase

from middleware.consensus.strategies.average import Average
from middleware.consensus.strategies.rendezvous import Centre, Median, Rendezvous, centre, median
from middleware.consensus.strategy import Report

numbers = st.floats(-1e6, 1e6, allow_nan=False).map(lambda x: round(x, 3))
places = st.lists(st.tuples(numbers, numbers), min_size=1, max_size=8)


def paths(here: tuple[float, ...], points: list[tuple[float, float]]) -> float:
    """Return the sum of the distances from all points."""
    return math.fsum(math.dist(here, p) for p in points)


class AverageTests(SynchronousTestCase):
    def test_mean_by_weight(self) -> None:
        """The average is weighted, and the agent with the lowest cost publishes it."""
        found = Average().find([Report("a", 2.0, value=(1.0,)), Report("b", 1.0, value=(4.0,), weight=2.0)])
        self.assertEqual((found.value, found.assigned_agent), ((3.0,), "b"))

    @settings(max_examples=100)
    @given(places, st.randoms(use_true_random=False))
    def test_identical_for_all(self, points: list[tuple[float, float]], dice: random.Random) -> None:
        """In any order of reports every strategy gives bit-identical numbers within the bounding box of the points."""
        reports = [Report(f"a{n}", 1.0, value=p) for n, p in enumerate(points)]
        mixed = dice.sample(reports, len(reports))
        for strategy in (Average(), Rendezvous(), Centre(), Median()):
            value = strategy.find(reports).value
            self.assertEqual(strategy.find(mixed).value, value)
            for number, axis in zip(value, zip(*points, strict=True), strict=True):
                self.assertTrue(min(axis) <= number <= max(axis), (strategy.name, value, points))

    def test_newest_value(self) -> None:
        """A newer value of an agent replaces its older value; a report without a value or weight does not count."""
        reports = [
            Report("a", 1.0, value=(9.0,)),
            Report("a", 1.0, value=(1.0,), sequence=1),
            Report("b", 1.0),
            Report("c", 1.0, value=(7.0,), weight=0.0),
            Report("d", 1.0, value=(3.0,)),
        ]
        self.assertEqual(Average().find(reports).value, (2.0,))


class RendezvousTests(SynchronousTestCase):
    def test_centre(self) -> None:
        """The centre minimizes the longest distance: no nearby point has a shorter longest distance."""
        for seed in range(200):
            dice = random.Random(seed)
            points = [(float(dice.randint(0, 9)), float(dice.randint(0, 9))) for _ in range(dice.randint(1, 7))]
            longest = max(math.dist(centre(points), p) for p in points)
            for one, other in combinations(points, 2):
                self.assertGreaterEqual(longest, math.dist(one, other) / 2 - 1e-9)
            for _ in range(30):
                near = tuple(x + dice.gauss(0.0, 0.3) for x in centre(points))
                self.assertLessEqual(longest, max(math.dist(near, p) for p in points) + 1e-9)

    def test_median(self) -> None:
        """The median minimizes the sum of distances, even if the median is one of the points."""
        for seed in range(60):
            dice = random.Random(seed)
            points = [(float(dice.randint(0, 9)), float(dice.randint(0, 9))) for _ in range(dice.randint(1, 7))]
            found = median(points, [1.0] * len(points))
            for _ in range(30):
                near = tuple(x + dice.gauss(0.0, dice.choice([0.01, 0.5])) for x in found)
                self.assertLessEqual(paths(found, points), paths(near, points) + 1e-3)
        corner = [(0.0, 0.0), (0.0, 0.0), (0.0, 0.0), (9.0, 9.0)]
        self.assertEqual(median(corner, [1.0] * 4), (0.0, 0.0))

    def test_dimensions(self) -> None:
        """Centres and medians are also computed in one and three dimensions."""
        self.assertEqual(centre([(0.0,), (1.0,), (9.0,)]), (4.5,))
        here = centre([(0.0, 0.0, 0.0), (2.0, 0.0, 0.0), (1.0, 0.5, 0.0)])
        self.assertLess(math.dist(here, (1.0, 0.0, 0.0)), 0.02)
