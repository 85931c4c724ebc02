"""Tests of the laws of ``find`` and ``merge`` for every strategy, with valid and invalid reports."""

from __future__ import annotations

import math
import random
from functools import partial

from hypothesis import given, settings
from hypothesis import strategies as st
from twisted.trial.unittest import SynchronousTestCase

from middleware.consensus.conformance import make_team
from middleware.consensus.strategies.nearest import SUMMARY_REPORTS
from middleware.consensus.strategy import BUILT_IN, Report, load_strategy

reports = st.builds(
    Report,
    agent=st.sampled_from(["a", "a", "b", "b", "c", ""]),
    cost=st.sampled_from([1.0, 1.0, 2.0, 2.0, 7, 8.5, 0.0, -0.0, math.nan, math.inf, -1.0, 1e300]),
    task=st.sampled_from(["", "", "", "", "t", "u"]),
    epoch=st.sampled_from([0, 0, 0, 0, 1]),
    sequence=st.integers(0, 2),
    value=st.sampled_from([(), (1.0,), (2.0,), (1.0, 2.0), (3.0, -4.0), (8.0, 9.0), (math.nan,)]),
    choice=st.sampled_from(["", "left", "right"]),
    weight=st.sampled_from([0.0, 1.0, 2.5]),
    electorate=st.sampled_from([0.0, 4.0]),
    capacity=st.sampled_from([0, 1, 2]),
    battery=st.sampled_from([0.1, 1.0]),
    age=st.sampled_from([0.0, 0.0, 1.0, 3.0]),
    valid_for=st.sampled_from([0.0, 2.0]),
)
views = st.lists(reports, max_size=7)


class LawTests(SynchronousTestCase):
    def hold(self, name: str) -> None:
        """Check all laws for one strategy."""

        @settings(max_examples=60)
        @given(views, views, views, st.randoms(use_true_random=False))
        def laws(a: list[Report], b: list[Report], c: list[Report], dice: random.Random) -> None:
            strategy = load_strategy(name)
            ab = strategy.merge(a, b)
            self.assertEqual(ab, strategy.merge(b, a))
            self.assertEqual(strategy.merge(ab, c), strategy.merge(a, strategy.merge(b, c)))
            self.assertEqual(strategy.merge(ab, ab), ab)
            found = strategy.find([*a, *b])
            self.assertEqual(strategy.find(ab), found)
            self.assertEqual(load_strategy(name).find(dice.sample([*b, *a], len(a) + len(b))), found)
            self.assertEqual(strategy.find([*a, *b, *a]), found)

        laws()

    def test_short_summaries(self) -> None:
        """Merging summaries of only the best reports gives the same result as all reports, in any grouping."""
        for name in ("nearest", "capability_cost"):
            strategy = load_strategy(name)
            for seed in range(20):
                dice = random.Random(seed)
                contacts = make_team(dice, 100)
                summary: tuple[Report, ...] = ()
                for start in range(0, len(contacts), 7):
                    summary = strategy.merge(strategy.merge((), contacts[start : start + 7]), summary)
                self.assertLessEqual(len(summary), SUMMARY_REPORTS)
                self.assertEqual(strategy.find(summary), strategy.find(contacts))


def _law_test(name: str) -> None:
    test = partial(LawTests.hold, name=name)

    def method(self: LawTests) -> None:
        test(self)

    method.__doc__ = f"The order, grouping and repetition of reports make no difference to {name}."
    setattr(LawTests, f"test_{name}", method)


for _name in sorted(BUILT_IN):
    _law_test(_name)
