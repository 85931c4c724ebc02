"""Tests of how often far contacts are asked; pure."""

from __future__ import annotations

import random

from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.kademlia.sounding import FIRST, GONE, LEAST, MOST, Pace


class PaceTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.pace = Pace()

    def test_within_bounds(self) -> None:
        """Where nobody goes contacts are asked ever more rarely, where all go ever more often, both within bounds."""
        self.assertEqual(self.pace.wait, FIRST)
        for _ in range(100):
            self.pace.answered()
        self.assertEqual(self.pace.wait, MOST)
        for _ in range(100):
            self.pace.lost()
        self.assertEqual(self.pace.wait, LEAST)

    def test_it_follows_what_is_seen(self) -> None:
        """With sessions of any usual length it settles where about one in twenty of those asked is gone."""
        dice = random.Random(1)
        for stay in (600.0, 1500.0, 4000.0):
            gone = asked = 0
            for _ in range(20_000):
                if dice.random() < 1 - 2.718 ** (-self.pace.wait / stay):
                    self.pace.lost()
                    gone += 1
                else:
                    self.pace.answered()
                asked += 1
            self.assertApproximates(gone / asked, GONE, 0.02)
