"""Tests of ``Nearest``, the strategy of the thesis."""

from __future__ import annotations

import math

from hypothesis import given, settings
from hypothesis import strategies as st
from twisted.trial.unittest import SynchronousTestCase

from middleware.consensus.strategies.nearest import SUMMARY_REPORTS, Nearest
from middleware.consensus.strategy import Report, refusal

costs = st.one_of(st.floats(), st.sampled_from([0.0, -0.0, 1.0, 2.0]))
reports = st.lists(st.builds(Report, st.sampled_from("abcde"), costs), max_size=8)


class NearestTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.nearest = Nearest()

    def test_lowest_cost_wins(self) -> None:
        """The nearest agent wins, and the other agents are standbys in the order of their distances."""
        found = self.nearest.find([Report("a", 2.0), Report("b", 0.5), Report("c", 1.0)])
        self.assertEqual((found.assigned_agent, found.standby), ("b", ("c", "a")))

    def test_ties(self) -> None:
        """The agent id breaks ties, so there is exactly one winner; 0 and -0 are equal."""
        self.assertEqual(self.nearest.find([Report("b", 1.0), Report("a", 1.0)]).assigned_agent, "a")
        self.assertEqual(self.nearest.find([Report("b", -0.0), Report("a", 0.0)]).assigned_agent, "a")

    @settings(max_examples=100)
    @given(reports, st.randoms(use_true_random=False))
    def test_order_and_repetition_do_not_matter(self, contacts: list[Report], rng: object) -> None:
        """The consensus and its digest do not depend on the order or repetition of the reports."""
        found = self.nearest.find(contacts)
        mixed = [*contacts, *contacts[:2]]
        rng.shuffle(mixed)  # type: ignore[attr-defined]
        self.assertEqual(self.nearest.find(mixed), found)
        named = [found.assigned_agent, *found.standby] if found.assigned_agent else []
        lawful = {r.agent for r in contacts if not refusal(r)}
        self.assertEqual((len(named), len(set(named))), (min(SUMMARY_REPORTS, len(lawful)),) * 2)
        self.assertLessEqual(set(named), lawful)

    def test_improves(self) -> None:
        """An offer is an improvement if it is nearer by more than the hysteresis, but not if its cost is invalid."""
        rows = [
            (1.0, 0.89, True),
            (1.0, 0.9, False),
            (1.0, 0.95, False),
            (1.0, 2.0, False),
            (0.0, 0.0, False),
            (math.inf, 1.0, True),
            (1.0, -5.0, False),
            (1.0, math.nan, False),
            (1.0, -math.inf, False),
            (math.nan, 1.0, True),
        ]
        for current, offer, expected in rows:
            improves = self.nearest.improves(Report("a", current), Report("b", offer), 0.1)
            self.assertEqual(improves, expected, (current, offer))
