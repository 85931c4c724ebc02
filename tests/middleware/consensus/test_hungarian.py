"""Tests of the exact assignment."""

from __future__ import annotations

import random
import time
from itertools import permutations

from twisted.trial.unittest import SynchronousTestCase

from middleware.consensus.strategies import hungarian
from middleware.consensus.strategies.hungarian import assigned, solved, total


class HungarianTests(SynchronousTestCase):
    def table(self, dice: random.Random, most: int = 6) -> list[list[int]]:
        """Random costs, many of them equal."""
        rows = dice.randint(1, most - 1)
        columns = dice.randint(rows, most)
        high = dice.choice([1, 2, 3, 10, 1000, 2**60])
        return [[dice.randint(0, high) for _ in range(columns)] for _ in range(rows)]

    def test_against_every_assignment(self) -> None:
        """It is the cheapest of all there are, and of equals the first; with huge costs too."""
        dice = random.Random(1)
        for _ in range(400):
            costs = self.table(dice)
            best = min(
                (sum(row[c] for row, c in zip(costs, columns, strict=True)), columns)
                for columns in permutations(range(len(costs[0])), len(costs))
            )
            self.assertEqual(tuple(assigned(costs, with_scipy=False)), best[1], costs)

    def test_prices_prove_it(self) -> None:
        """Each row has a column that is cheapest for it at these prices; what nobody has is free of charge."""
        dice = random.Random(2)
        for _ in range(200):
            costs = self.table(dice, 9)
            columns, prices = solved(costs)
            self.assertEqual(len(set(columns)), len(costs))
            for row, column in zip(costs, columns, strict=True):
                self.assertEqual(row[column] - prices[column], min(c - p for c, p in zip(row, prices, strict=True)))
            self.assertTrue(all(p <= 0 for p in prices))
            self.assertTrue(all(p == 0 for c, p in enumerate(prices) if c not in columns))

    def test_both_solvers(self) -> None:
        """With SciPy, where it is installed, everything is the same; where it cannot be exact it is not asked."""
        dice = random.Random(3)
        for _ in range(200):
            costs = self.table(dice, 9)
            self.assertEqual(assigned(costs, with_scipy=True), assigned(costs, with_scipy=False), costs)
        self.assertIsNone(hungarian._by_scipy([[2**60]]))

    def test_edges(self) -> None:
        """Nothing to assign, one place, and all equal are no special cases."""
        self.assertEqual(assigned([]), [])
        self.assertEqual(assigned([[7]]), [0])
        self.assertEqual(assigned([[5] * 4] * 3), [0, 1, 2])
        self.assertEqual(total([[5] * 4] * 3, [0, 1, 2]), 15)

    def test_speed(self) -> None:
        """300 x 300 takes no more than a second of processor also on a busy machine (0.1 s on a quiet one)."""
        dice = random.Random(4)
        costs = [[dice.randrange(10**6) for _ in range(300)] for _ in range(300)]
        began = time.process_time()
        assigned(costs, with_scipy=False)
        self.assertLess(time.process_time() - began, 1.0)
