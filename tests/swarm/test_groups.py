"""Tests of whole teams in memory with several tasks in one group."""

from __future__ import annotations

from itertools import permutations

from middleware.diagnostics.explanation import EpochExplanation, explain_decisions
from middleware.tasks.task import Task
from swarmnode.simulated_team import SimulatedTeam
from tests.swarm.case import TeamCase

TASKS = {"t0": 1.5, "t1": 2.5, "t2": -2.5}
"""The direction in radians for each task.  If the nearest dog did each task, the dogs would turn more in total."""
SLOW = 0.25
"""Turn velocity in radians per second: the shortest turn takes one second, the other turns at least four."""
DOGS = SimulatedTeam.DOGS


class GroupTests(TeamCase):
    def setUp(self) -> None:
        self.use_facing()
        self.costs: dict[str, dict[str, float]] = {}
        self.began: dict[str, list[str]] = {}
        self.twice: list[object] = []
        self.agreed = False

    def busy_team(self, dogs: tuple[str, ...] = DOGS, strategy: str = "group_optimal") -> SimulatedTeam:
        """Start a team and submit the tasks, one after the other."""
        team = self.start_team(5, dogs)
        team.clock.advance(0.5)
        for name, towards in TASKS.items():
            parameters = {"towards": towards, "speed": SLOW}
            shared = {"requirements": {"compass": {}}, "strategy": strategy, "waiting_period": 3.0, "group": "g"}
            task = Task(name, "facing", name, parameters=parameters, created=team.clock.seconds(), **shared)  # type: ignore[arg-type]
            self.submit(team, task)
            team.clock.advance(0.15)
        return team

    def look(self, team: SimulatedTeam) -> None:
        """Record the first costs, the dogs that start each task, and dogs that act on two tasks simultaneously."""
        acting: dict[str, list[str]] = {}
        for name in TASKS:
            for member in self.members(team, name):
                if member.cost is not None:
                    self.costs.setdefault(name, {}).setdefault(member.name, member.cost)
                if member.status == "EXECUTING":
                    acting.setdefault(member.name, []).append(name)
                    if member.name not in self.began.setdefault(name, []):
                        self.began[name].append(member.name)
        digests = {m.digest for name in TASKS for m in self.members(team, name)}
        self.agreed = self.agreed or (len(digests) == 1 and "" not in digests)
        self.twice += [pair for pair in acting.items() if len(pair[1]) > 1]

    def are_done(self, team: SimulatedTeam) -> bool:
        """Return whether all tasks are completed."""
        return [task["status"] for task in team.state()["tasks"]] == ["COMPLETED"] * len(TASKS)

    def by(self, team: SimulatedTeam) -> dict[str, str]:
        """Return the dog that completed each task."""
        return {task["id"]: task["result"]["by"] for task in team.state()["tasks"] if task["result"] is not None}

    def ruling(self, team: SimulatedTeam, name: str) -> EpochExplanation:
        """Return the explanation of the newest decision on a task."""
        return explain_decisions(self.verdicts(team, name)).epochs[0]

    def test_each_dog_does_one(self) -> None:
        """Each of three dogs does one of three tasks; the tasks are done simultaneously, with the lowest total cost.

        All dogs agree, and all their reports on the three tasks have the same digest.
        """
        team = self.busy_team()
        self.until(team, lambda: len(self.began) == len(TASKS))
        self.assertTrue(self.agreed)
        team.clock.advance(1.0)
        for name in TASKS:
            ruling = self.ruling(team, name)
            self.assertEqual((len(ruling.agree), ruling.of, ruling.rule), (3, 3, "group_optimal"))
            self.assertEqual(ruling.chosen, self.began[name][0])
        self.until(team, lambda: self.are_done(team))
        by = self.by(team)
        self.assertEqual(sorted(by.values()), list(DOGS))
        self.assertEqual({name: [dog] for name, dog in by.items()}, self.began)
        self.assertEqual(self.twice, [])
        best = min(sum(self.costs[t][d] for t, d in zip(TASKS, order, strict=True)) for order in permutations(DOGS))
        self.assertAlmostEqual(sum(self.costs[name][dog] for name, dog in by.items()), best)

    def test_nearest_one_by_one_costs_more(self) -> None:
        """With ``nearest`` the same tasks are assigned one by one, and the total cost is higher."""
        team = self.busy_team(strategy="nearest")
        self.until(team, lambda: self.are_done(team), 60.0)
        best = min(sum(self.costs[t][d] for t, d in zip(TASKS, order, strict=True)) for order in permutations(DOGS))
        self.assertGreater(sum(self.costs[name][dogs[0]] for name, dogs in self.began.items()), best + 0.5)
        self.assertEqual(self.twice, [])

    def test_task_of_a_dead_dog_is_done_by_another(self) -> None:
        """The task of a dead dog goes to the next free dog; the other tasks continue."""
        team = self.busy_team()
        self.until(team, lambda: len(self.began) == len(TASKS))
        lost = max(TASKS, key=lambda name: self.costs[name][self.began[name][0]])
        dead = self.began[lost][0]
        team.kill(dead)
        self.until(team, lambda: self.are_done(team), 60.0)
        by = self.by(team)
        self.assertNotEqual(by[lost], dead)
        self.assertEqual(self.began[lost], [dead, by[lost]])
        for name in TASKS:
            if name != lost:
                self.assertEqual(self.began[name], [by[name]])
        self.assertEqual(self.twice, [])

    def test_operator_gives_a_group(self) -> None:
        """Predefined tasks in one group are done simultaneously by different dogs, and the page shows the group."""
        team = self.start_team(5)
        for _ in DOGS:
            team.control.assign("turn-around", group="yard")
        self.until(team, lambda: self.are_done(team))
        self.assertEqual(sorted(self.by(team).values()), list(DOGS))
        groups = {(task["group"], task["strategy"]) for task in team.state()["tasks"]}
        self.assertEqual(groups, {("yard", "group_optimal")})
        began = [task["created"] + task["result"]["took"] for task in team.state()["tasks"]]
        self.assertLess(max(began) - min(began), 3.0)

    def test_newcomer_takes_what_is_left(self) -> None:
        """Two busy dogs leave the third task open; a dog that joins executes it."""
        team = self.busy_team(("dog1", "dog2"))
        self.until(team, lambda: len(self.began) == 2)
        (left,) = set(TASKS) - set(self.began)
        self.assertIn("all bidders have reached their capacity", {m.why for m in self.members(team, left)})
        team.add_node("dog3")
        self.until(team, lambda: left in self.began)
        self.assertEqual(self.began[left], ["dog3"])
        self.until(team, lambda: self.are_done(team), 60.0)
        self.assertEqual(self.twice, [])
