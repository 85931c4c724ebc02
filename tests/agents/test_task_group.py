"""Tests of ``agents.task_group``: every agent assigns the tasks of a group from the same reports."""

from __future__ import annotations

import random
from dataclasses import replace
from itertools import permutations
from types import SimpleNamespace
from typing import Any

from twisted.trial.unittest import SynchronousTestCase

from agents.decision import Decision, decide
from agents.loop import select_participation
from agents.task_group import GROUP_SETTLE_S, TaskGroup, get_group_key
from middleware.consensus.guarded_strategy import GuardedStrategy
from middleware.consensus.strategy import load_strategy
from middleware.directory.presence import EXECUTING, SEARCHING, WAITING
from middleware.tasks.task import Member, Task
from tests.invariants.tasks import Groups

AGENTS = ("a", "b", "c")
Costs = dict[str, dict[str, float | None]]
"""The cost of each task for each agent."""


def task(name: str, **fields: Any) -> Task:
    """Return a task of the group."""
    return Task(name, "walk", name, strategy="group_optimal", group="g", waiting_period=8.0, **fields)


def members(costs: dict[str, float | None], acting: str = "") -> list[Member]:
    """Return the reports on one task."""
    statuses = {
        agent: EXECUTING if agent == acting else SEARCHING if c is None else WAITING for agent, c in costs.items()
    }
    return [Member(agent, f"dog-{agent}", statuses[agent], cost) for agent, cost in costs.items()]


class TaskGroupTests(SynchronousTestCase):
    def division(self, costs: Costs, strategy: str = "group_optimal", **acting: str) -> TaskGroup:
        """Return the assignment of all tasks after the gathering period; ``acting`` maps a task to its acting agent."""
        task_group = TaskGroup(GuardedStrategy(load_strategy(strategy)))
        for name, row in costs.items():
            here = members(row, acting.get(name, ""))
            task_group.join(task(name), lambda now, here=here: here, 0.0)  # type: ignore[misc]
        return task_group

    def decided(self, costs: Costs, now: float = 50.0, since: float = 40.0, **acting: Any) -> dict[str, Decision]:
        """Return the decision on each task."""
        division = self.division(costs, **acting)
        found = {}
        for name, row in costs.items():
            share = division.make_strategy(task(name), now, since)
            found[name] = decide(members(row, acting.get(name, "")), share, 0.1, 8.0, since)
        return found

    def assigned(self, costs: Costs, **acting: Any) -> dict[str, str | None]:
        """Return the assigned agent of each task."""
        return {name: decision.assigned for name, decision in self.decided(costs, **acting).items()}

    def test_optimum_of_all_tasks(self) -> None:
        """Each agent is assigned one task, and no other assignment has a lower total cost."""
        rng = random.Random(4)
        for _ in range(50):
            costs: Costs = {t: {a: round(rng.uniform(0.0, 9.0), 2) for a in AGENTS} for t in ("t1", "t2", "t3")}
            given = self.assigned(costs)
            self.assertEqual(sorted(map(str, given.values())), list(AGENTS))
            total = sum(costs[t][str(a)] or 0.0 for t, a in given.items())
            best = min(
                sum(costs[t][a] or 0.0 for t, a in zip(costs, order, strict=True)) for order in permutations(AGENTS)
            )
            self.assertAlmostEqual(total, best)

    def test_one_digest_of_all_reports(self) -> None:
        """The decisions on all tasks have the same digest of all reports, and their reasons describe the assignment."""
        costs: Costs = {"t1": {"a": 1.0, "b": 2.0}, "t2": {"a": 1.5, "b": 5.0}}
        first = self.decided(costs)
        self.assertEqual(first["t1"].digest, first["t2"].digest)
        self.assertEqual(first["t1"].why, "dog-b, 2.00, assigned with 1 other task among 2 agents")
        costs["t2"]["b"] = 6.0
        other = self.decided(costs)
        self.assertNotEqual(first["t1"].digest, other["t1"].digest)
        self.assertNotEqual(first["t1"].basis, other["t1"].basis)
        one_by_one = self.division(costs, "nearest")
        shares = [one_by_one.make_strategy(task(name), 50.0, 40.0).find([]) for name in costs]
        self.assertEqual(len({point.digest for point in shares}), 1)

    def test_more_tasks_than_agents(self) -> None:
        """With more tasks than agents, one task is not assigned, because all bidders have reached their capacity."""
        found = self.decided({"t1": {"a": 1.0}, "t2": {"a": 2.0}})
        self.assertEqual((found["t1"].assigned, found["t2"].assigned), ("a", None))
        self.assertEqual(found["t2"].why, "all bidders have reached their capacity")

    def test_who_acts_counts_for_its_task_alone(self) -> None:
        """An agent that acts on a task gets no second task of the group, even if it is the nearest agent.

        A free agent gets the second task.
        """
        costs: Costs = {"t1": {"a": 1.0, "b": 9.0}, "t2": {"a": 0.1, "b": 9.0}}
        self.assertEqual(self.assigned(costs, t1="a"), {"t1": "a", "t2": "b"})
        self.assertEqual(self.assigned({"t1": costs["t1"], "t2": {"a": 0.1}}, t1="a"), {"t1": "a", "t2": None})

    def test_who_acts_keeps_it_within_the_hysteresis(self) -> None:
        """A free agent takes over a task only if its cost is lower by the hysteresis.

        Otherwise the free agent gets a different task.
        """
        for cost, given in ((0.95, "a"), (0.85, "b")):
            self.assertEqual(self.assigned({"t1": {"a": 1.0, "b": cost}}, t1="a"), {"t1": given})
        costs: Costs = {"t1": {"a": 1.0, "b": 0.95}, "t2": {"b": 9.0}}
        for strategy in ("group_optimal", "cbba"):
            points = self.division(costs, strategy, t1="a").make_strategy(task("t2"), 50.0, 40.0).find([])
            self.assertEqual(points.assigned_agent, "b", strategy)

    def test_group_is_gathered_first(self) -> None:
        """No agent is assigned before the gathering period ends, except an agent that is already acting."""
        costs: Costs = {"t1": {"a": 1.0, "b": 0.1}, "t2": {"a": 2.0, "b": 2.0}}
        for now, given, why in (
            (GROUP_SETTLE_S - 0.1, None, "waiting for the rest of the group"),
            (GROUP_SETTLE_S, "b", ""),
        ):
            decision = self.decided(costs, now)["t1"]
            self.assertEqual(decision.assigned, given)
            self.assertTrue(decision.why.startswith(why))
        held = self.decided(costs, 0.5, t1="a")["t1"]
        self.assertEqual((held.assigned, len(held.digest)), ("a", 8))

    def test_missing_reports_on_other_tasks_are_waited_for(self) -> None:
        """During the waiting period no agent is assigned until all have reported on every task of the group."""
        costs: Costs = {"t1": {"a": 1.0, "b": 2.0}, "t2": {"a": 1.0, "b": None}}
        found = self.decided(costs, since=7.9)
        self.assertEqual((found["t1"].assigned, found["t1"].why), (None, "waiting for dog-b"))
        self.assertEqual(self.decided(costs, since=8.0)["t1"].assigned, "b")
        self.assertEqual(self.decided(costs, since=7.9, t2="a")["t1"].assigned, "b")

    def test_what_is_divided_together(self) -> None:
        """Tasks with the same group, strategy and requirements are assigned jointly.

        A task without a group is assigned alone.
        """
        one = task("t1", requirements={"camera": {"width": 1, "colour": "rgb"}, "legs": {}})
        two = task("t2", requirements={"legs": {}, "camera": {"colour": "rgb", "width": 1}})
        self.assertEqual(get_group_key(one), get_group_key(two))
        for other in (replace(two, group="h"), replace(two, strategy="cbba"), replace(two, requirements={})):
            self.assertNotEqual(get_group_key(one), get_group_key(other))
        self.assertIsNone(get_group_key(replace(one, group="")))

    def test_schedules(self) -> None:
        """In random schedules each task ends once, no agent acts on two tasks, and all agents reach equal decisions."""
        broken = {seed: found for seed in range(6) if (found := Groups(seed).run())}
        self.assertEqual(broken, {})


class SelectParticipationTests(SynchronousTestCase):
    """The choice of the task in a group that controls the robot."""

    def part(self, cost: float | None = 1.0, assigned: str = "", is_acting: bool = False, is_free: bool = True) -> Any:
        """Return a task and its state as seen by the agent."""
        me = Member("a", "dog", WAITING, cost, assigned)
        return SimpleNamespace(engagement=SimpleNamespace(me=me, is_acting=is_acting, can_yield_robot=is_free))

    def test_given_task_has_it(self) -> None:
        """The robot works on its agent's assigned task.

        However, if the agent still acts on another task or records that task's outcome, the robot stays with that task.
        """
        other, given = self.part(None), self.part(assigned="a")
        self.assertIs(select_participation([other, given], other), given)
        for holder in (self.part(is_acting=True), self.part(is_free=False)):
            self.assertIs(select_participation([given, holder], holder), holder)

    def test_else_what_it_cannot_tell_yet(self) -> None:
        """Without an assigned task the robot measures a task of unknown cost; if there is none, it keeps its task."""
        reported, unknown, also = self.part(), self.part(None), self.part(None, assigned="b")
        self.assertIs(select_participation([reported, unknown, also], reported), unknown)
        self.assertIs(select_participation([reported, unknown, also], also), also)
        self.assertIs(select_participation([reported, unknown], None), unknown)
        last = self.part(assigned="b")
        self.assertIs(select_participation([reported, last], last), last)
        self.assertIs(select_participation([reported, last], None), reported)
