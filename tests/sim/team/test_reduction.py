"""Tests of the reduction of failing runs; a function decides whether a reduced run fails, without a simulation."""

from __future__ import annotations

import itertools
import random
from collections.abc import Iterator

from twisted.trial.unittest import SynchronousTestCase

from sim.team.shrinking import NO_REDUCTION, Reduction, minimize, reduce_run


class MinimizeTests(SynchronousTestCase):
    def test_those_that_are_needed(self) -> None:
        """``minimize`` finds exactly the faults that cause the failure, in fewer than 60 attempts."""
        rng = random.Random(1)
        for _ in range(50):
            needed = set(rng.sample(range(16), rng.randrange(4)))
            tries = itertools.count()

            def fails(kept: tuple[int, ...], needed: set[int] = needed, tries: Iterator[int] = tries) -> bool:
                next(tries)
                return needed <= set(kept)

            self.assertEqual(set(minimize(range(16), fails)), needed)
            self.assertLess(next(tries), 60)

    def test_none_can_be_dropped(self) -> None:
        """If several sets of faults cause the failure, the result is one of them, without superfluous faults."""

        def fails(kept: tuple[int, ...]) -> bool:
            return {1, 2} <= set(kept) or {5, 6, 7} <= set(kept)

        found = minimize(range(8), fails)
        self.assertTrue(fails(found))
        self.assertFalse(any(fails(tuple(set(found) - {number})) for number in found))


class ReduceRunTests(SynchronousTestCase):
    def test_all_that_can_go_goes(self) -> None:
        """Faults, link impairments, workloads and seconds are removed if the run fails without them."""

        def fails(trim: Reduction) -> bool:
            is_long = trim.limit_duration(20.0) >= 5.0
            return trim.keeps(3) and is_long and (not trim.only or "records" in trim.only)

        found = reduce_run(NO_REDUCTION, 5, ["records", "wire"], 20.0, fails)
        self.assertEqual(found, Reduction((3,), True, ("records",), 5.0))

    def test_what_is_needed_stays(self) -> None:
        """A failing run of which every part is needed is not reduced."""
        whole = Reduction((0, 1), False, ("records", "wire"))
        self.assertEqual(
            reduce_run(NO_REDUCTION, 2, ["records", "wire"], 20.0, lambda trim: trim == NO_REDUCTION).keep, (0, 1)
        )
        self.assertEqual(reduce_run(whole, 2, ["records", "wire"], 20.0, lambda trim: trim == whole), whole)

    def test_no_more_time(self) -> None:
        """When the time limit is reached, the smallest run that has failed is the result."""
        tries = iter([False, True])
        found = reduce_run(NO_REDUCTION, 4, ["records"], 20.0, lambda trim: next(tries, False))
        self.assertEqual(found, Reduction((2, 3)))
