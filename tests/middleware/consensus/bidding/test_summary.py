"""Tests of the summary of bids, with joins of two summaries, and with strategies that misbehave."""

from __future__ import annotations

import random
from collections.abc import Sequence

from hypothesis import given, settings
from hypothesis import strategies as st
from twisted.trial.unittest import SynchronousTestCase

from middleware.consensus.bidding.bid import Bid
from middleware.consensus.bidding.merge_rule import MAX_LEADING_REPORTS, MAX_REPORTS, MergeRule, select_leading
from middleware.consensus.bidding.summary import MAX_SUPERSEDING, Summary
from middleware.consensus.strategies.nearest import Nearest
from middleware.consensus.strategy import Consensus, Report
from tests.middleware.consensus.bidding.ground import AGENTS, bid, rule

Spoken = tuple[int, float | None, int]
places = st.integers(0, 7)
costs = st.sampled_from([0.0, 1.0, 2.0, 3.0, None])
batches = st.lists(st.lists(st.tuples(places, costs, st.integers(0, 2)), max_size=4), max_size=6)


def unsigned(place: int, cost: float | None, revision: int) -> Bid:
    """Return a bid without a signature; bids from equal arguments are equal."""
    agent = AGENTS[place]
    return Bid(agent.public, None if cost is None else Report(agent.node_id.hex(), cost), revision)


class Finding:
    """A strategy without ``merge``."""

    find = Nearest().find


class SummaryTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.summary = Summary(rule())

    def test_best_stand(self) -> None:
        """If the strategy has no ``merge``, the summary keeps the cheapest bids, in any order of arrival."""
        self.summary = Summary(MergeRule(Finding()))
        for place, cost in ((3, 4.0), (4, 1.0), (5, 9.0), (6, 2.0), (7, 3.0), (8, 8.0)):
            self.summary.join([bid(place, cost)])
        self.assertEqual([report.cost for report in self.summary.standing], [1.0, 2.0, 3.0, 4.0])
        self.assertEqual(len(self.summary.list_bids()), MAX_LEADING_REPORTS)

    def test_change_is_told(self) -> None:
        """``join`` returns whether the bids changed the summary; a duplicate bid changes nothing."""
        self.assertTrue(self.summary.join([bid(3, 1.0)]))
        self.assertFalse(self.summary.join([bid(3, 1.0)]))
        self.assertFalse(self.summary.join([]))

    @given(batches, st.randoms(use_true_random=False))
    @settings(max_examples=80, deadline=None)
    def test_join_is_idempotent_and_takes_any_order(self, batches: list[list[Spoken]], dice: random.Random) -> None:
        """The summary does not depend on the order or number of repetitions of the bids."""
        batch = [[unsigned(*each) for each in one] for one in batches]
        straight, mixed = Summary(rule()), Summary(rule())
        for one in batch:
            straight.join(one)
        again = [*batch, *batch]
        dice.shuffle(again)
        for one in again:
            mixed.join(one)
        # A displaced bid counts again only when it is joined after a better bid was withdrawn. So both summaries join
        # each batch again before the comparison.
        for one in batch:
            straight.join(one)
            mixed.join(one)
        self.assertEqual(straight.standing, mixed.standing)

    def test_late_copy_of_an_earlier_bid(self) -> None:
        """A late duplicate of a withdrawn or superseded bid does not become valid again."""
        self.summary.join([bid(3, 1.0)])
        self.summary.join([bid(3, None, 1)])
        self.summary.join([bid(3, 1.0)])
        self.assertEqual(self.summary.standing, ())
        self.summary.join([bid(place, 2.0) for place in range(4, 9)])
        self.summary.join([bid(3, 9.0, 2)])
        self.summary.join([bid(3, 1.0)])
        self.assertNotIn(1.0, [report.cost for report in self.summary.standing])

    def test_two_things_at_once(self) -> None:
        """Two different bids of one agent with the same revision give the same summary in either order."""
        other = Summary(rule())
        self.summary.join([bid(3, 1.0)])
        self.summary.join([bid(3, 5.0)])
        other.join([bid(3, 5.0)])
        other.join([bid(3, 1.0)])
        self.assertEqual(self.summary.standing, other.standing)

    def test_room(self) -> None:
        """The number of withdrawals that a summary keeps is limited."""
        for number in range(MAX_SUPERSEDING + 50):
            self.summary.join([Bid(number.to_bytes(32), None, 1)])
        self.assertEqual(len(self.summary.list_bids()), MAX_SUPERSEDING)


class Raising(Nearest):
    def find(self, contacts: Sequence[Report]) -> Consensus:
        """Raise."""
        raise ZeroDivisionError

    def merge(self, a: Sequence[Report], b: Sequence[Report]) -> tuple[Report, ...]:
        """Raise."""
        raise ZeroDivisionError


class Lying(Nearest):
    def find(self, contacts: Sequence[Report]) -> Consensus:
        """Choose an agent that has not bid."""
        return Consensus("nobody")

    def merge(self, a: Sequence[Report], b: Sequence[Report]) -> tuple[Report, ...]:
        """Return an invented bid and all given bids."""
        return (Report("nobody", 0.0), *a, *b)


class Hoarding(Nearest):
    def merge(self, a: Sequence[Report], b: Sequence[Report]) -> tuple[Report, ...]:
        """Return all bids, some of them twice."""
        return (*a, *b, *b)


class RuleTests(SynchronousTestCase):
    def test_strategy_that_raises(self) -> None:
        """If the strategy raises, the failing method is reported and the nearest reports are kept."""
        blamed: list[str] = []
        raising = MergeRule(Raising(), lambda method, error: blamed.append(method))
        both = (Report("a", 2.0), Report("b", 1.0))
        self.assertEqual(raising.merge(both, ()), (both[1], both[0]))
        self.assertEqual(raising.decide(both)[0], "b")
        self.assertEqual(blamed, ["merge", "find"])

    def test_strategy_that_lies(self) -> None:
        """Reports and winners that a strategy invents are ignored."""
        lying = MergeRule(Lying())
        both = (Report("a", 2.0), Report("b", 1.0))
        self.assertEqual(lying.merge(both, ()), (both[1], both[0]))
        self.assertEqual(lying.decide(both)[0], "b")
        self.assertIsNone(lying.decide(())[0])

    def test_strategy_that_hoards(self) -> None:
        """A summary contains at most ``MAX_REPORTS`` reports, and one report of each agent."""
        reports = [Report(f"{n:040}", float(n)) for n in range(MAX_REPORTS + 100)]
        self.assertEqual(len(MergeRule(Hoarding()).merge(reports, reports)), MAX_REPORTS)
        twice = MergeRule(Hoarding()).merge([Report("a", 1.0)], [Report("a", 2.0)])
        self.assertEqual(twice, (Report("a", 1.0),))

    @given(*(st.lists(st.builds(Report, st.sampled_from("abcdefgh"), st.floats(0, 9))) for _ in range(3)))
    @settings(max_examples=60, deadline=None)
    def test_leading_is_a_join(self, a: list[Report], b: list[Report], c: list[Report]) -> None:
        """The join of the built-in summary is commutative, associative and idempotent."""
        self.assertEqual(select_leading(a, b), select_leading(b, a))
        self.assertEqual(select_leading(select_leading(a, b), c), select_leading(a, select_leading(b, c)))
        self.assertEqual(select_leading(select_leading(a, b), b), select_leading(a, b))
