"""Tests of averages, meeting points, and of the average without anybody who gathers."""

from __future__ import annotations

import math
import random
from itertools import combinations

from hypothesis import given, settings
from hypothesis import strategies as st
from twisted.trial.unittest import SynchronousTestCase

from middleware.consensus.strategies.average import Average
from middleware.consensus.strategies.push_sum import PushSum, Share
from middleware.consensus.strategies.rendezvous import Centre, Median, Rendezvous, centre, median
from middleware.consensus.strategy import Report

numbers = st.floats(-1e6, 1e6, allow_nan=False).map(lambda x: round(x, 3))
places = st.lists(st.tuples(numbers, numbers), min_size=1, max_size=8)


def ways(here: tuple[float, ...], points: list[tuple[float, float]]) -> float:
    """The sum of the ways from all points."""
    return math.fsum(math.dist(here, p) for p in points)


class AverageTests(SynchronousTestCase):
    def test_mean_by_weight(self) -> None:
        """The average counts weights, and the cheapest publishes it."""
        found = Average().find([Report("a", 2.0, value=(1.0,)), Report("b", 1.0, value=(4.0,), weight=2.0)])
        self.assertEqual((found.value, found.assigned_agent), ((3.0,), "b"))

    @settings(max_examples=100, deadline=None, derandomize=True, database=None)
    @given(places, st.randoms(use_true_random=False))
    def test_identical_for_all(self, points: list[tuple[float, float]], dice: random.Random) -> None:
        """In any order every strategy gives the identical numbers, to the last bit, within the box of the points."""
        reports = [Report(f"a{n}", 1.0, value=p) for n, p in enumerate(points)]
        mixed = dice.sample(reports, len(reports))
        for strategy in (Average(), Rendezvous(), Centre(), Median()):
            value = strategy.find(reports).value
            self.assertEqual(strategy.find(mixed).value, value)
            for number, axis in zip(value, zip(*points, strict=True), strict=True):
                self.assertTrue(min(axis) <= number <= max(axis), (strategy.name, value, points))

    def test_newest_value(self) -> None:
        """A newer value replaces an older one; who has none, or no weight, does not count."""
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
        """The centre makes the longest way as short as possible: nowhere near is it shorter."""
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
        """From nowhere near the median is the sum of ways shorter; also where it is one of the points."""
        for seed in range(60):
            dice = random.Random(seed)
            points = [(float(dice.randint(0, 9)), float(dice.randint(0, 9))) for _ in range(dice.randint(1, 7))]
            found = median(points, [1.0] * len(points))
            for _ in range(30):
                near = tuple(x + dice.gauss(0.0, dice.choice([0.01, 0.5])) for x in found)
                self.assertLessEqual(ways(found, points), ways(near, points) + 1e-3)
        corner = [(0.0, 0.0), (0.0, 0.0), (0.0, 0.0), (9.0, 9.0)]
        self.assertEqual(median(corner, [1.0] * 4), (0.0, 0.0))

    def test_dimensions(self) -> None:
        """On a line and in space there are centres and medians too."""
        self.assertEqual(centre([(0.0,), (1.0,), (9.0,)]), (4.5,))
        here = centre([(0.0, 0.0, 0.0), (2.0, 0.0, 0.0), (1.0, 0.5, 0.0)])
        self.assertLess(math.dist(here, (1.0, 0.0, 0.0)), 0.02)


class PushSumTests(SynchronousTestCase):
    def run_team(self, count: int, seed: int, loss: float, rounds: int) -> list[PushSum]:
        """Rounds of giving, with messages and acknowledgements lost, doubled and late."""
        dice = random.Random(seed)
        team = {f"a{n}": PushSum(f"a{n}", [dice.uniform(0, 100)]) for n in range(count)}
        names = list(team)
        self.mean = math.fsum(one.mass[0] for one in team.values()) / count
        for _ in range(rounds):
            sent: list[tuple[str, Share]] = []
            for name, one in team.items():
                sent += one.unacknowledged()
                other = dice.choice([n for n in names if n != name])
                sent.append((other, one.give(other)))
            for taker, share in dice.sample(sent, len(sent)):
                for _ in range(2 if dice.random() < 0.1 else 1):
                    if dice.random() >= loss:
                        number = team[taker].take(share)
                        if dice.random() >= loss:
                            team[share.giver].acknowledged(number)
        self.team = team
        return list(team.values())

    def mass(self) -> tuple[float, float]:
        """All there is, in hand and on its way, each share once."""
        on_the_way = [
            share
            for one in self.team.values()
            for taker, share in one.unacknowledged()
            if not self.team[taker].has_taken(share)
        ]
        held = list(self.team.values())
        return (
            math.fsum([one.mass[0] for one in held] + [share.mass[0] for share in on_the_way]),
            math.fsum([one.weight for one in held] + [share.weight for share in on_the_way]),
        )

    def test_converges(self) -> None:
        """Without loss everybody is within a millionth after 4 log2 N + 40 rounds."""
        for count in (2, 10, 100):
            for one in self.run_team(count, count, 0.0, round(4 * math.log2(count)) + 40):
                self.assertLess(abs(one.value[0] - self.mean) / self.mean, 1e-6)

    def test_mass_stays(self) -> None:
        """Nothing is lost and nothing counts twice, whatever is lost or doubled."""
        for loss in (0.0, 0.1, 0.3):
            self.run_team(12, 3, loss, 25)
            mass, weight = self.mass()
            self.assertAlmostEqual(mass / 12, self.mean, 9)
            self.assertAlmostEqual(weight, 12.0, 9)

    def test_join_and_leave(self) -> None:
        """Who comes adds its value, who goes leaves everything to another."""
        one, other = PushSum("a", [1.0]), PushSum("b", [5.0])
        other.take(one.give("b", whole=True))
        self.assertEqual((other.value, other.weight, one.weight, one.value), ((3.0,), 2.0, 0.0, ()))
        newcomer = PushSum("c", [9.0])
        other.take(newcomer.give("b", whole=True))
        self.assertEqual(other.value, (5.0,))
