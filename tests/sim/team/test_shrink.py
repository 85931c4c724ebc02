"""Shrinking, over runs that are nothing but rules of what fails."""

from __future__ import annotations

import itertools
import random
from collections.abc import Iterator

from twisted.trial.unittest import SynchronousTestCase

from sim.team.shrink import WHOLE, Trim, fewest, shrunk


class FewestTests(SynchronousTestCase):
    def test_those_that_are_needed(self) -> None:
        """Of many faults exactly those are left which it takes, wherever they stand, in few tries."""
        rng = random.Random(1)
        for _ in range(50):
            needed = set(rng.sample(range(16), rng.randrange(4)))
            tries = itertools.count()

            def fails(kept: tuple[int, ...], needed: set[int] = needed, tries: Iterator[int] = tries) -> bool:
                next(tries)
                return needed <= set(kept)

            self.assertEqual(set(fewest(range(16), fails)), needed)
            self.assertLess(next(tries), 60)

    def test_none_can_be_dropped(self) -> None:
        """Where several sets fail, what is left fails, and does not without any one of its faults."""

        def fails(kept: tuple[int, ...]) -> bool:
            return {1, 2} <= set(kept) or {5, 6, 7} <= set(kept)

        found = fewest(range(8), fails)
        self.assertTrue(fails(found))
        self.assertFalse(any(fails(tuple(set(found) - {number})) for number in found))


class ShrunkTests(SynchronousTestCase):
    def test_all_that_can_go_goes(self) -> None:
        """Faults, weather, workloads and seconds that a failure does not need are taken away."""

        def fails(trim: Trim) -> bool:
            is_long = trim.within(20.0) >= 5.0
            return trim.keeps(3) and is_long and (not trim.only or "records" in trim.only)

        found = shrunk(WHOLE, 5, ["records", "wire"], 20.0, fails)
        self.assertEqual(found, Trim((3,), True, ("records",), 5.0))

    def test_what_is_needed_stays(self) -> None:
        """A failure that needs all of it is left as it is."""
        whole = Trim((0, 1), False, ("records", "wire"))
        self.assertEqual(shrunk(WHOLE, 2, ["records", "wire"], 20.0, lambda trim: trim == WHOLE).keep, (0, 1))
        self.assertEqual(shrunk(whole, 2, ["records", "wire"], 20.0, lambda trim: trim == whole), whole)

    def test_no_more_time(self) -> None:
        """When there is no more time to try, what failed last is what is left."""
        tries = iter([False, True])
        found = shrunk(WHOLE, 4, ["records"], 20.0, lambda trim: next(tries, False))
        self.assertEqual(found, Trim((2, 3)))
