"""Tests of the weighted vote."""

from __future__ import annotations

import random

from twisted.trial.unittest import SynchronousTestCase

from middleware.consensus.strategies.weighted_vote import WeightedVote
from middleware.consensus.strategy import Report


def vote(agent: str, choice: str, weight: float = 1.0, **more: object) -> Report:
    """Return one vote in an electorate of five."""
    return Report(agent, 1.0, choice=choice, weight=weight, **{"electorate": 5.0, **more})  # type: ignore[arg-type]


class WeightedVoteTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.vote = WeightedVote()

    def test_majority(self) -> None:
        """More than half of the total weight decides immediately.

        Of the agents that voted for the decision, the agent with the lowest cost acts.
        """
        votes = [vote("a", "red"), vote("b", "red")]
        self.assertEqual(self.vote.find(votes).choice, "")
        found = self.vote.find([*votes, Report("c", 0.5, choice="red", electorate=5.0)])
        self.assertEqual((found.choice, found.assigned_agent, found.standby), ("red", "c", ("a", "b")))

    def test_weights(self) -> None:
        """Votes count by their weights, not by their number."""
        found = self.vote.find([vote("a", "red", 3.0), vote("b", "blue"), vote("c", "blue")])
        self.assertEqual(found.choice, "red")

    def test_no_decision_below_quorum(self) -> None:
        """Half of the total weight does not decide, and the reason states that a majority is missing."""
        found = self.vote.find([vote("a", "red", 2.5)])
        self.assertEqual((found.choice, found.assigned_agent), ("", None))
        self.assertIn("more than half of 5", found.reason)

    def test_a_vote_each(self) -> None:
        """A new vote of an agent replaces its previous vote; repeated votes count once."""
        twice = [vote("a", "red", sequence=n) for n in range(5)]
        self.assertEqual(self.vote.find(twice).choice, "")
        changed = [vote("a", "red"), vote("b", "red"), vote("c", "red"), vote("c", "blue", sequence=1)]
        self.assertEqual(self.vote.find(changed).choice, "")
        self.assertEqual(self.vote.find([*changed, vote("c", "red", sequence=2)]).choice, "red")

    def test_digest_of_all_votes(self) -> None:
        """The digest covers all counted votes, including the votes of the losing side."""
        red = [vote("a", "red", 2.0), vote("b", "red")]
        digests = {self.vote.find([*red, vote("c", choice)]).digest for choice in ("blue", "green")}
        self.assertEqual(len(digests), 2)

    def test_all_have_voted(self) -> None:
        """When all agents have voted, the option with the most weight wins without a majority; a hash breaks ties."""
        votes = [
            vote(name, choice) for name, choice in zip("abcde", ["red", "red", "blue", "blue", "green"], strict=True)
        ]
        found = {self.vote.find(random.Random(seed).sample(votes, 5)).choice for seed in range(20)}
        self.assertEqual(len(found), 1)
        self.assertIn(found.pop(), ("red", "blue"))
        self.assertEqual(self.vote.find(votes[:4]).choice, "")

    def test_who_has_not_voted(self) -> None:
        """An agent that has not voted is part of the electorate, so silence cannot produce a majority."""
        present = [Report("a", 1.0, choice="red"), Report("b", 1.0), Report("c", 1.0)]
        self.assertEqual(self.vote.find(present).choice, "")
        self.assertEqual(self.vote.find([*present[:2], Report("c", 1.0, choice="red")]).choice, "red")

    def test_two_quorums_never_differ(self) -> None:
        """Two subsets of the same votes never lead to different decisions."""
        for seed in range(300):
            dice = random.Random(seed)
            weights = [dice.choice([1.0, 2.0, 3.0]) for _ in range(7)]
            votes = [
                vote(f"a{n}", dice.choice(["red", "blue", "green"]), weight, electorate=sum(weights))
                for n, weight in enumerate(weights)
            ]
            found = {self.vote.find(dice.sample(votes, dice.randint(1, 7))).choice for _ in range(10)}
            self.assertLessEqual(len(found - {""}), 1, votes)
