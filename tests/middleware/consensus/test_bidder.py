"""Tests of CBBA between agents: whatever the network does, they end at the sequential greedy assignment."""

from __future__ import annotations

import random

from hypothesis import given, settings
from hypothesis import strategies as st
from twisted.trial.unittest import SynchronousTestCase

from middleware.consensus.strategies.bidder import Bidder, Score, Statement
from middleware.consensus.strategies.cbba import greedy

Costs = dict[str, dict[str, float]]


def flat(row: dict[str, float]) -> Score:
    """What a task is worth does not depend on the bundle."""
    return lambda bundle, task: 1000.0 - row[task]


class Talk:
    """Bidders on a graph whose messages come late, twice and in any order, but come."""

    def __init__(self, seed: int, edges: list[tuple[str, str]], bidders: dict[str, Bidder]) -> None:
        self.dice = random.Random(seed)
        self.bidders = bidders
        self.way: list[tuple[str, str, tuple[Statement, ...]]] = []
        for one, other in edges:
            bidders[one].neighbours.append(other)
            bidders[other].neighbours.append(one)
        self.delivered = 0

    def run(self) -> None:
        """Until nobody has anything to say."""
        while True:
            for name, bidder in self.bidders.items():
                if self.dice.random() < 0.5 or not self.way:
                    self.way += [(name, to, said) for to, said in bidder.drain().items()]
            if not self.way:
                return
            number = self.dice.randrange(len(self.way))
            sender, taker, said = self.way[number]
            if self.dice.random() < 0.8:  # else it comes once more
                del self.way[number]
            corrections = self.bidders[taker].hear(sender, said)
            if corrections:
                self.way.append((taker, sender, tuple(corrections)))
            self.delivered += 1

    def owners(self) -> dict[str, list[str]]:
        """Who believes to have each task."""
        found: dict[str, list[str]] = {}
        for name, bidder in self.bidders.items():
            for task in bidder.bundle:
                found.setdefault(task, []).append(name)
        return found


def line(names: list[str], dice: random.Random) -> list[tuple[str, str]]:
    """A line through all, and some more edges."""
    edges = set(zip(names, names[1:], strict=False))
    edges |= {tuple(sorted(dice.sample(names, 2))) for _ in range(dice.randrange(4)) if len(names) > 1}  # type: ignore[misc]
    return sorted(edges)


class BidderTests(SynchronousTestCase):
    @settings(max_examples=150, deadline=None, derandomize=True, database=None)
    @given(st.integers(1, 8), st.integers(1, 8), st.integers(1, 3), st.integers(0, 10**6))
    def test_equals_greedy(self, agents: int, tasks: int, capacity: int, seed: int) -> None:
        """In any order of delivery, with repetitions, on any connected graph, all end at the greedy assignment."""
        dice = random.Random(seed)
        names = [f"a{n}" for n in range(agents)]
        goals = [f"t{n}" for n in range(tasks)]
        costs: Costs = {a: {t: dice.choice([1.0, 2.0, dice.uniform(0, 99)]) for t in goals} for a in names}
        bidders = {a: Bidder(a, goals, flat(costs[a]), capacity) for a in names}
        talk = Talk(seed, line(names, dice), bidders)
        talk.run()
        expected = greedy(costs, dict.fromkeys(names, capacity))
        self.assertEqual(talk.owners(), {task: [agent] for task, agent in expected.items()})
        for bidder in bidders.values():
            winners = {t: w.agent for t in goals if (w := bidder.winner(t)) is not None}
            self.assertEqual(winners, expected)

    def test_diminishing_gains(self) -> None:
        """Where each further task is worth less, they also end at the greedy assignment of marginal scores."""
        for seed in range(40):
            dice = random.Random(seed)
            names, goals = ["a", "b", "c"], ["s", "t", "u", "v"]
            worth = {a: {t: dice.uniform(1, 99) for t in goals} for a in names}

            def score(row: dict[str, float]) -> Score:
                return lambda bundle, goal: row[goal] / (1 + len(bundle))

            bidders = {a: Bidder(a, goals, score(worth[a]), 2) for a in names}
            talk = Talk(seed, [("a", "b"), ("b", "c")], bidders)
            talk.run()
            expected: dict[str, list[str]] = {}
            held: dict[str, int] = dict.fromkeys(names, 0)
            while len(expected) < len(goals):
                _, agent, task = min(
                    (-worth[a][t] / (1 + held[a]), a, t)
                    for a in names for t in goals if t not in expected and held[a] < 2
                )  # fmt: skip
                expected[task] = [agent]
                held[agent] += 1
            self.assertEqual(talk.owners(), expected)

    def test_warped(self) -> None:
        """Where tasks are worth more together, no bid rises within a bundle, and all come to rest without conflict."""
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
                bids = [w.bid for t in bidder.bundle if (w := bidder.winner(t)) is not None]
                self.assertEqual(bids, sorted(bids, reverse=True))

    def test_winning_bid_never_falls(self) -> None:
        """As long as worth does not depend on the bundle, what anybody knows to be the winning bid only rises."""
        dice = random.Random(5)
        names, goals = [f"a{n}" for n in range(6)], [f"t{n}" for n in range(6)]
        costs = {a: {t: dice.uniform(0, 99) for t in goals} for a in names}
        bidders = {a: Bidder(a, goals, flat(costs[a])) for a in names}
        talk = Talk(5, line(names, dice), bidders)
        seen: dict[tuple[str, str], float] = {}

        def watch(bidder: Bidder) -> None:
            for task in goals:
                winner = bidder.winner(task)
                bid = winner.bid if winner is not None else 0.0
                self.assertGreaterEqual(bid, seen.get((bidder.agent, task), 0.0))
                seen[bidder.agent, task] = bid

        for bidder in bidders.values():
            genuine = bidder.hear

            def heard(
                who: str, said: tuple[Statement, ...], bidder: Bidder = bidder, genuine: object = genuine
            ) -> list[Statement]:
                answer: list[Statement] = genuine(who, said)  # type: ignore[operator]
                watch(bidder)
                return answer

            bidder.hear = heard  # type: ignore[assignment, method-assign]
        talk.run()

    def test_born_again(self) -> None:
        """Who lost its memory within an epoch is told what it said, and says otherwise with a higher number."""
        old, other = (
            Bidder("a", ["s", "t"], flat({"s": 1.0, "t": 2.0})),
            Bidder("b", ["s", "t"], flat({"s": 9.0, "t": 9.0})),
        )
        talk = Talk(1, [("a", "b")], {"a": old, "b": other})
        talk.run()
        again = Bidder("a", ["s", "t"], flat({"s": 2.0, "t": 1.0}), neighbours=["b"])
        talk.bidders["a"] = again
        other.hear("a", again.drain()["b"])
        talk.way.append(("b", "a", tuple(other._known["s"].values())))
        talk.run()
        self.assertEqual(talk.owners(), {"t": ["a"], "s": ["b"]})

    def test_nonsense(self) -> None:
        """Bids that are no numbers, endless or below zero, and tasks that nobody gave out, are not heard."""
        bidder = Bidder("b", ["t"], flat({"t": 1.0}))
        bad = [Statement("t", "a", 1, bid) for bid in (float("nan"), float("inf"), -1.0, 1e300)]
        self.assertEqual(bidder.hear("a", [*bad, Statement("zzz", "a", 1, 5.0)]), [])
        winner = bidder.winner("t")
        assert winner is not None
        self.assertEqual(winner.agent, "b")

    def test_rounds(self) -> None:
        """In step, on a line, they are through after at most as many rounds as tasks times the diameter, and one."""
        for seed in range(20):
            dice = random.Random(seed)
            names, goals = [f"a{n}" for n in range(8)], [f"t{n}" for n in range(5)]
            bidders = {
                a: Bidder(a, goals, flat({t: dice.uniform(0, 99) for t in goals}), 1,
                          [b for b in names if abs(int(a[1]) - int(b[1])) == 1])
                for a in names
            }  # fmt: skip
            rounds = 0
            while any(not bidder.is_quiet for bidder in bidders.values()):
                rounds += 1
                said = [(a, to, news) for a, bidder in bidders.items() for to, news in bidder.drain().items()]
                for a, to, news in said:
                    bidders[a].hear(to, bidders[to].hear(a, news))
            self.assertLessEqual(rounds, 5 * 7 + 1)
