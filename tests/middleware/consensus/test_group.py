"""Tests of the strategies that assign several tasks: validity and cost of the assignments."""

from __future__ import annotations

import math
import random
from collections import Counter
from itertools import product
from statistics import fmean

from twisted.trial.unittest import SynchronousTestCase

from middleware.consensus.assignment import Item, to_millionths
from middleware.consensus.strategies.cbba import Cbba, assign_greedily, improve_assignment
from middleware.consensus.strategies.group_optimal import GroupOptimal
from middleware.consensus.strategies.sequential import Sequential, compute_length, plan_routes
from middleware.consensus.strategy import Consensus, Report

Place = tuple[float, float]


def square(agents: int, tasks: int, seed: int, capacity: int = 0) -> tuple[list[Report], list[Item]]:
    """Return a random mission in the unit square: all bids, and the tasks."""
    dice = random.Random(f"square/{agents}/{tasks}/{seed}")
    starts = {f"a{n:03d}": (dice.random(), dice.random()) for n in range(agents)}
    items = [Item(f"t{n:03d}", (dice.random(), dice.random())) for n in range(tasks)]
    room = capacity or math.ceil(tasks / agents)
    return [
        Report(agent, math.dist(start, item.position), task=item.task, value=start, capacity=room)
        for agent, start in starts.items()
        for item in items
    ], items


def cost(points: tuple[Consensus, ...], reports: list[Report]) -> float:
    """Return the cost of an assignment."""
    known = {(r.agent, r.task): r.cost for r in reports}
    return sum(known[agent, point.task] for point in points for agent in point.assigned)


class MultiTaskTests(SynchronousTestCase):
    def test_one_of_several(self) -> None:
        """For reports of several tasks ``find`` returns the decision on the first task of the joint assignment."""
        bids = {("a", "s"): 1.0, ("b", "s"): 2.0, ("a", "t"): 1.0, ("b", "t"): 10.0}
        reports = [Report(agent, cost, task=task) for (agent, task), cost in bids.items()]
        for strategy in (Cbba(), GroupOptimal()):
            found = strategy.find(reports)
            self.assertEqual((found.task, found.assigned_agent, found.standby), ("s", "b", ("a",)), strategy.name)


class GroupOptimalTests(SynchronousTestCase):
    def test_optimum(self) -> None:
        """If every agent bids for every task, the cost is the minimum over all assignments."""
        for seed in range(30):
            reports, items = square(3, 4, seed)
            known = {(r.agent, r.task): r.cost for r in reports}
            agents = sorted({r.agent for r in reports})
            best = min(
                sum(known[agent, item.task] for agent, item in zip(chosen, items, strict=True))
                for chosen in product(agents, repeat=4)
                if all(chosen.count(agent) <= 2 for agent in chosen)
            )
            self.assertAlmostEqual(cost(GroupOptimal().find_group(reports, items), reports), best, 5)

    def test_twenty_bids(self) -> None:
        """If each agent sends only its best 20 bids, every task is assigned, at a cost within 2 % of the optimum."""
        ratios = []
        for seed in range(4):
            reports, items = square(60, 60, seed)
            best = GroupOptimal()
            best.bids = 1000
            few = GroupOptimal().find_group(reports, items)
            self.assertNotIn(None, [point.assigned_agent for point in few])
            ratios.append(cost(few, reports) / cost(best.find_group(reports, items), reports))
        self.assertLessEqual(fmean(ratios), 1.02)

    def test_second_pass(self) -> None:
        """A task that is not among any agent's best bids is assigned from the remaining bids."""
        reports = [Report("a", float(n), task=f"t{n:02d}", capacity=30) for n in range(30)]
        found = GroupOptimal().find_group(reports, [Item(f"t{n:02d}") for n in range(30)])
        self.assertEqual({point.assigned_agent for point in found}, {"a"})

    def test_slots(self) -> None:
        """A task with two slots gets two different agents."""
        reports = [Report(a, c, task=t, capacity=2) for a, c in (("a", 1.0), ("b", 5.0)) for t in ("s", "t")]
        found = GroupOptimal().find_group(reports, [Item("s", slots=2), Item("t", slots=2)])
        self.assertEqual([point.assigned for point in found], [("a", "b"), ("a", "b")])

    def test_holes_say_why(self) -> None:
        """An unassigned task has a reason, and no agent gets more tasks than its capacity."""
        reports = [Report("a", 1.0, task="s"), Report("a", 2.0, task="t")]
        found = GroupOptimal().find_group(reports, [Item("s"), Item("t"), Item("u")])
        self.assertEqual([point.assigned_agent for point in found], ["a", None, None])
        self.assertEqual(found[1].reason, "all bidders have reached their capacity")
        self.assertEqual(found[2].reason, "no agent bid for the task")

    def test_equal_optima(self) -> None:
        """Of several optimal assignments the same one is always chosen."""
        reports = [Report(a, 1.0, task=t) for a in "abc" for t in "xyz"]
        found = GroupOptimal().find_group(reports, [Item(t) for t in "xyz"])
        self.assertEqual([point.assigned_agent for point in found], ["a", "b", "c"])


class CbbaTests(SynchronousTestCase):
    def test_exchange_never_costs(self) -> None:
        """Exchanges never increase the cost, respect capacities, and reduce the mean to within 5 % of the optimum."""
        ratios = []
        for seed in range(12):
            agents = random.Random(seed).choice([5, 20, 40])
            reports, items = square(agents, 40, seed)
            costs: dict[str, dict[str, int]] = {}
            for report in reports:
                costs.setdefault(report.agent, {})[report.task] = to_millionths(report.cost)
            room = {agent: math.ceil(40 / agents) for agent in costs}
            before = assign_greedily(costs, room)
            after = improve_assignment(before, costs, room)
            sums = [sum(costs[a][t] for t, a in owner.items()) for owner in (before, after)]
            self.assertLessEqual(sums[1], sums[0])
            self.assertEqual(set(after), set(before))
            self.assertTrue(all(list(after.values()).count(agent) <= room[agent] for agent in room))
            best = GroupOptimal()
            best.bids = 1000
            ratios.append(
                cost(Cbba().find_group(reports, items), reports) / cost(best.find_group(reports, items), reports)
            )
        self.assertLessEqual(fmean(ratios), 1.05)

    def test_nothing_left_to_exchange(self) -> None:
        """After the exchanges, no move of one task and no swap of two reduces the cost. Capacities are respected."""
        for seed in range(60):
            dice = random.Random(seed)
            tasks = [f"t{n}" for n in range(9)]
            costs = {f"a{n}": {t: dice.randrange(99) for t in tasks if dice.random() < 0.6} for n in range(6)}
            room = {agent: dice.randint(1, 3) for agent in costs}
            # The greedy assignment for inverted costs is a bad start.
            worst = assign_greedily({agent: {t: -c for t, c in row.items()} for agent, row in costs.items()}, room)
            owner = improve_assignment(worst, costs, room)
            held = Counter(owner.values())
            self.assertTrue(all(held[agent] <= room[agent] for agent in held))
            for task, agent in owner.items():
                free = [row[task] for other, row in costs.items() if held[other] < room[other] and task in row]
                self.assertLessEqual(costs[agent][task], min(free, default=99))
                for other, theirs in owner.items():
                    if other in costs[agent] and task in costs[theirs]:
                        now = costs[agent][task] + costs[theirs][other]
                        self.assertLessEqual(now, costs[agent][other] + costs[theirs][task])


class SequentialTests(SynchronousTestCase):
    def test_each_task_once(self) -> None:
        """Each task is on one route, no route exceeds the capacity, and the decisions match the routes."""
        for seed in range(10):
            reports, items = square(4, 10, seed, capacity=3)
            routes = plan_routes(reports, items) or {}
            self.assertEqual(sorted(t for route in routes.values() for t in route), [item.task for item in items])
            self.assertLessEqual(max(map(len, routes.values())), 3)
            found = Sequential().find_group(reports, items)
            self.assertEqual({p.task: p.assigned_agent for p in found}, {t: a for a, w in routes.items() for t in w})

    def test_twice_the_best_at_most(self) -> None:
        """The total length of the routes is at most twice the optimum, and on average at most 1.15 times."""
        ratios = []
        for seed in range(25):
            reports, items = square(2, 5, seed, capacity=5)
            starts = {r.agent: r.value for r in reports}
            places = {item.task: item.position for item in items}
            routes = plan_routes(reports, items) or {}
            mine = sum(compute_length(starts[a], [places[t] for t in route]) for a, route in routes.items())
            ratios.append(mine / self.best(list(starts.values()), list(places.values())))
        self.assertLessEqual(max(ratios), 2.0)
        self.assertLessEqual(fmean(ratios), 1.15)

    def best(self, starts: list[tuple[float, ...]], places: list[tuple[float, ...]]) -> float:
        """Return the minimum total length of the routes of two agents, by exhaustive search."""
        shortest: dict[tuple[int, int], float] = {}
        for which, start in enumerate(starts):
            ends: dict[tuple[int, int], float] = {(1 << n, n): math.dist(start, p) for n, p in enumerate(places)}
            for mask in range(1, 1 << len(places)):
                for last in range(len(places)):
                    if (mask, last) in ends:
                        for n, p in enumerate(places):
                            if not mask >> n & 1:
                                route = ends[mask, last] + math.dist(places[last], p)
                                key = (mask | 1 << n, n)
                                ends[key] = min(route, ends.get(key, math.inf))
            for mask in range(1, 1 << len(places)):
                shortest[which, mask] = min(route for (m, _), route in ends.items() if m == mask)
            shortest[which, 0] = 0.0
        whole = (1 << len(places)) - 1
        return min(shortest[0, mask] + shortest[1, whole - mask] for mask in range(whole + 1))

    def test_without_places(self) -> None:
        """If positions are missing or have different dimensions, only the bids count."""
        reports = [Report("a", 2.0, task="t"), Report("b", 1.0, task="t", value=(1.0,))]
        for items in ([Item("t")], [Item("t", (1.0, 2.0))]):
            self.assertEqual([p.assigned_agent for p in Sequential().find_group(reports, items)], ["b"])

    def test_only_what_it_bid_for(self) -> None:
        """An agent that bids for named tasks gets only these; an agent that names no task may get any task."""
        items = [Item("s", (0.0, 0.0)), Item("t", (1.0, 0.0))]
        near = Report("near", 0.0, task="s", value=(0.5, 0.0), capacity=2)
        self.assertEqual(plan_routes([near], items), {"near": ["s"]})
        far = Report("far", 0.0, value=(9.0, 0.0), capacity=2)
        self.assertEqual(Sequential().find_group([near, far], items)[1].assigned_agent, "far")
