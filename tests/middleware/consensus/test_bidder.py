"""Tests of the bidders of the CBBA benchmark, which reach the greedy assignment on any network."""

from __future__ import annotations

import random

from hypothesis import given, settings
from hypothesis import strategies as st
from twisted.trial.unittest import SynchronousTestCase

from benchmarks.consensus.bidder import Bidder, Score, Statement
from middleware.consensus.strategies.cbba import assign_greedily

Costs = dict[str, dict[str, float]]


def flat(row: dict[str, float]) -> Score:
    """Return a score that does not depend on the agent's other tasks (its bundle)."""
    return lambda bundle, task: 1000.0 - row[task]


class Talk:
    """Bidders on a graph that delivers messages late, repeatedly and in any order, but delivers each message."""

    def __init__(self, seed: int, edges: list[tuple[str, str]], bidders: dict[str, Bidder]) -> None:
        self.dice = random.Random(seed)
        self.bidders = bidders
        self.way: list[tuple[str, str, tuple[Statement, ...]]] = []
        for one, other in edges:
            bidders[one].neighbours.append(other)
            bidders[other].neighbours.append(one)
        self.delivered = 0

    def run(self) -> None:
        """Deliver messages until no bidder has a message to send."""
        while True:
            for name, bidder in self.bidders.items():
                if self.dice.random() < 0.5 or not self.way:
                    self.way += [(name, to, said) for to, said in bidder.drain().items()]
            if not self.way:
                return
            number = self.dice.randrange(len(self.way))
            sender, taker, said = self.way[number]
            if self.dice.random() < 0.8:  # a message that is not removed here is delivered again later
                del self.way[number]
            corrections = self.bidders[taker].receive(sender, said)
            if corrections:
                self.way.append((taker, sender, tuple(corrections)))
            self.delivered += 1

    def owners(self) -> dict[str, list[str]]:
        """Return for each task the agents that consider themselves its owner."""
        found: dict[str, list[str]] = {}
        for name, bidder in self.bidders.items():
            for task in bidder.bundle:
                found.setdefault(task, []).append(name)
        return found


def line(names: list[str], dice: random.Random) -> list[tuple[str, str]]:
    """Return a graph that is a line through all names, with some additional edges."""
    edges = set(zip(names, names[1:], strict=False))
    edges |= {tuple(sorted(dice.sample(names, 2))) for _ in range(dice.randrange(4)) if len(names) > 1}  # type: ignore[misc]
    return sorted(edges)


class BidderTests(SynchronousTestCase):
    @settings(max_examples=150)
    @given(st.integers(1, 8), st.integers(1, 8), st.integers(1, 3), st.integers(0, 10**6))
    def test_equals_greedy(self, agents: int, tasks: int, capacity: int, seed: int) -> None:
        """On any connected graph, in any order and with repetitions, all bidders reach the greedy assignment."""
        dice = random.Random(seed)
        names = [f"a{n}" for n in range(agents)]
        goals = [f"t{n}" for n in range(tasks)]
        costs: Costs = {a: {t: dice.choice([1.0, 2.0, dice.uniform(0, 99)]) for t in goals} for a in names}
        bidders = {a: Bidder(a, goals, flat(costs[a]), capacity) for a in names}
        talk = Talk(seed, line(names, dice), bidders)
        talk.run()
        expected = assign_greedily(costs, dict.fromkeys(names, capacity))
        self.assertEqual(talk.owners(), {task: [agent] for task, agent in expected.items()})
        for bidder in bidders.values():
            winners = {t: w.agent for t in goals if (w := bidder.find_winner(t)) is not None}
            self.assertEqual(winners, expected)

    def test_warped(self) -> None:
        """Even if scores grow with the size of the bundle, bids never increase in it, and all bidders converge."""
        for seed in range(40):
            dice = random.Random(seed)
            names, goals = [f"a{n}" for n in range(5)], [f"t{n}" for n in range(6)]
            worth = {a: {t: dice.uniform(1, 99) for t in goals} for a in names}

            def score(row: dict[str, float]) -> Score:
                return lambda bundle, goal: row[goal] * (1 + 3 * len(bundle))

            bidders = {a: Bidder(a, goals, score(worth[a]), 3) for a in names}
            talk = Talk(seed, line(names, dice), bidders)
            talk.run()
            self.assertLess(talk.delivered, 5000)
            self.assertEqual([o for o in talk.owners().values() if len(o) > 1], [])
            for bidder in bidders.values():
                bids = [w.bid for t in bidder.bundle if (w := bidder.find_winner(t)) is not None]
                self.assertEqual(bids, sorted(bids, reverse=True))
