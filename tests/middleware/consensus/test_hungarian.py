"""Tests of the optimal assignment."""

from __future__ import annotations

import random
from itertools import permutations

from twisted.trial.unittest import SynchronousTestCase

from middleware.consensus.strategies.hungarian import find_optimum, solve


class HungarianTests(SynchronousTestCase):
    def table(self, dice: random.Random, most: int = 6) -> list[list[int]]:
        """Return random costs, many of them equal."""
        rows = dice.randint(1, most - 1)
        columns = dice.randint(rows, most)
        high = dice.choice([1, 2, 3, 10, 1000, 2**60])
        return [[dice.randint(0, high) for _ in range(columns)] for _ in range(rows)]

    def test_against_every_assignment(self) -> None:
        """The assignment has the lowest cost; of several such assignments it is the first.

        Both hold for huge costs, too.
        """
        dice = random.Random(1)
        for _ in range(400):
            costs = self.table(dice)
            best = min(
                (sum(row[c] for row, c in zip(costs, columns, strict=True)), columns)
                for columns in permutations(range(len(costs[0])), len(costs))
            )
            self.assertEqual(tuple(solve(costs)), best[1], costs)

    def test_prices_prove_it(self) -> None:
        """The prices prove that the assignment is optimal.

        Each row is assigned the column with the lowest cost minus price; unassigned columns have price 0.
        """
        dice = random.Random(2)
        for _ in range(200):
            costs = self.table(dice, 9)
            columns, prices = find_optimum(costs)
            self.assertEqual(len(set(columns)), len(costs))
            for row, column in zip(costs, columns, strict=True):
                self.assertEqual(row[column] - prices[column], min(c - p for c, p in zip(row, prices, strict=True)))
            self.assertTrue(all(p <= 0 for p in prices))
            self.assertTrue(all(p == 0 for c, p in enumerate(prices) if c not in columns))

    def test_edges(self) -> None:
        """No rows, a single cell and equal costs are handled."""
        self.assertEqual(solve([]), [])
        self.assertEqual(solve([[7]]), [0])
        self.assertEqual(solve([[5] * 4] * 3), [0, 1, 2])
