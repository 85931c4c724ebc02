"""A shared test case for whole teams in memory."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from twisted.internet.defer import Deferred
from twisted.trial.unittest import SynchronousTestCase

from agents.behaviour import KINDS
from middleware.consensus.decision_record import DecisionRecord, decision_records_key, parse_decision_record
from middleware.tasks.task import Member, Task, group_key, parse_member
from sim.robots.scene import FOOTPRINT_RADIUS_M
from swarmnode.simulated_team import LAN, SimulatedTeam

LOOK_S = 0.05


class TeamCase(SynchronousTestCase):
    """Tests of a team that consists of a laptop and three dogs."""

    def start_team(
        self,
        seed: int = 3,
        dogs: tuple[str, ...] = SimulatedTeam.DOGS,
        loss: float = 0.0,
        others: tuple[str, ...] = (),
    ) -> SimulatedTeam:
        """Start a team that is stopped at the end of the test."""
        team = SimulatedTeam(seed, conditions=replace(LAN, loss=loss), dogs=dogs, others=others)
        self.addCleanup(team.stop)
        return team

    def until(self, team: SimulatedTeam, is_so: Callable[[], bool], limit: float = 90.0) -> float:
        """Run the team until a condition is true; return the seconds, or fail after ``limit`` seconds."""
        started_at = team.clock.seconds()
        while not is_so():
            if team.clock.seconds() - started_at > limit:
                self.fail(f"not so within {limit:g} s: {team.state()['tasks']}")
            team.clock.advance(LOOK_S)
            self.look(team)
        return team.clock.seconds() - started_at

    def look(self, team: SimulatedTeam) -> None:
        """Do nothing; ``until`` calls this method after each step, and test cases can override it."""

    def task(self, team: SimulatedTeam) -> dict[str, Any]:
        """Return the newest task in the page's state."""
        tasks = team.state()["tasks"]
        return dict(tasks[0]) if tasks else {"status": "absent"}

    def device(self, team: SimulatedTeam, name: str) -> dict[str, Any]:
        """Return a device in the page's state."""
        return next((dict(row) for row in team.state()["devices"] if row["name"] == name), {"status": "absent"})

    def statuses(self, team: SimulatedTeam) -> dict[str, str]:
        """Return the status of each device."""
        return {row["name"]: row["status"] for row in team.state()["devices"]}

    def lines(self, team: SimulatedTeam, name: str) -> list[str]:
        """Return the messages of a device."""
        return [text for _, text in self.device(team, name)["messages"]]

    def executing(self, team: SimulatedTeam) -> list[str]:
        """Return the devices that execute the newest task."""
        groups = team.state()["groups"]
        return [m["name"] for m in groups[0]["members"] if m["status"] == "EXECUTING"] if groups else []

    def gap(self, team: SimulatedTeam, name: str) -> float:
        """Return the distance in metres between the dog's footprint and the target."""
        dog, target = team.simulator.world.dogs[name], team.simulator.world.target
        assert target is not None
        return math.hypot(dog.x - target.x, dog.y - target.y) - target.radius - FOOTPRINT_RADIUS_M

    def moving(self, team: SimulatedTeam) -> list[str]:
        """Return the dogs that are moving."""
        return [dog.name for dog in team.simulator.world.dogs.values() if dog.is_moving]

    def submit(self, team: SimulatedTeam, task: Task) -> None:
        """Publish a task through the laptop's node."""
        Deferred.fromCoroutine(team.services["vaio"].assembly.node.submit(task))

    def members(self, team: SimulatedTeam, task_id: str) -> list[Member]:
        """Return the reports on a task."""
        return [m for record in team.control.read(group_key(task_id)) if (m := parse_member(record)) is not None]

    def verdicts(self, team: SimulatedTeam, task_id: str) -> list[DecisionRecord]:
        """Return the decision records of a task."""
        return [
            v
            for record in team.control.read(decision_records_key(task_id))
            if (v := parse_decision_record(record)) is not None
        ]

    def use_facing(self) -> None:
        """Register the behaviour ``facing`` for the duration of this test."""
        KINDS["facing"] = "tests.swarm.facing:Facing"
        self.addCleanup(KINDS.pop, "facing")
