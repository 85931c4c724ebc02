"""Tests of a task with many bidders, in which only some agents, the reporters, write records."""

from __future__ import annotations

import random
from collections.abc import Mapping
from typing import Any

from twisted.internet.defer import Deferred
from twisted.trial.unittest import SynchronousTestCase

from agents.behaviour import KINDS, STAND
from agents.context import Context
from agents.engagement import Engagement
from agents.state import State
from drivers.reading import Action, Observation
from middleware.consensus.bidding.reporters import ENOUGH_RECORDS
from middleware.entangled.record import Record
from middleware.tasks.task import Task, parse_member
from sim.robots.crowd.scene import CrowdScene
from swarmnode.crowd import TASK_NODE, CrowdTeam

AGENTS = 24
ANNOUNCED = 4
STEP = 0.05


class Stand:
    """A behaviour that has a random cost and never finishes."""

    def __init__(self, parameters: Mapping[str, float | str], rng: random.Random) -> None:
        self.cost = round(1.0 + rng.random(), 3)

    def look(self, seen: Observation, now: float) -> None:
        """Ignore the observation."""

    def search(self, now: float) -> Action:
        """Stand still."""
        return STAND

    def hold(self, now: float) -> Action:
        """Stand still."""
        return STAND

    def execute(self, context: Context) -> Action:
        """Stand still forever."""
        return STAND


class ReportersTests(SynchronousTestCase):
    """Two dozen agents bid for one task."""

    def setUp(self) -> None:
        KINDS["stand"] = f"{__name__}:Stand"
        self.addCleanup(KINDS.pop, "stand")
        self.team = CrowdTeam(7, AGENTS, CrowdScene(30, 5.0, 5.0), camera_fps=0.0)
        self.addCleanup(self.team.stop)
        self.records: list[Record] = []
        node = self.team.services[TASK_NODE].assembly.node
        node.watch_group("job", self.heard)
        task = Task("job", "stand", "Stand", {"base2d": {}}, waiting_period=0.5)
        self.sent = self.team.switchboard.counters["sent"]
        Deferred.fromCoroutine(node.submit(task))

    def heard(self, records: list[Record]) -> None:
        """Store the records under the key of the task."""
        self.records = records

    def engagements(self) -> dict[str, Engagement]:
        """Return the engagement of each running agent."""
        named = {name: self.team.services[name] for name in self.team.simulator.names}
        agents: dict[str, Any] = {name: one.assembly.agent for name, one in named.items() if one.running}
        return {name: agent.engagement for name, agent in agents.items() if agent.engagement is not None}

    def acting(self) -> list[str]:
        """Return the names of the agents that execute the task."""
        return [name for name, one in self.engagements().items() if one.state_machine.state is State.EXECUTING]

    def run_until_one_acts(self, limit: float) -> tuple[str, float]:
        """Run until an agent acts; check that two agents never act simultaneously.

        Return the agent's name and the seconds.
        """
        began = self.team.clock.seconds()
        while not (acting := self.acting()):
            self.team.clock.advance(STEP)
            self.assertLess(self.team.clock.seconds() - began, limit)
        self.assertEqual(len(acting), 1)
        return acting[0], self.team.clock.seconds() - began

    def ranked(self) -> list[str]:
        """Return the running agents in the order of their costs, the lowest cost first."""
        every = self.engagements()
        return sorted(every, key=lambda name: (every[name].me.cost or 0.0, every[name].me.uuid))

    def test_best_acts_and_the_next_takes_over(self) -> None:
        """The best agent acts and all agents agree, with few records and datagrams.

        When the best agent vanishes, the next best agent takes over within 3 s.
        """
        name, _ = self.run_until_one_acts(5.0)
        self.assertEqual(name, self.ranked()[0])
        self.team.clock.advance(2.0)
        self.assertEqual((self.acting(), len(self.engagements())), ([name], AGENTS))
        sent = self.team.switchboard.counters["sent"] - self.sent
        self.assertLess(sent / AGENTS, 1000)
        members = {member.uuid for record in self.records if (member := parse_member(record)) is not None}
        # Some agents write a report before the last announcement reaches them.
        self.assertLessEqual(len(members), ENOUGH_RECORDS + 2 * ANNOUNCED)
        uuid = self.engagements()[name].me.uuid
        self.assertEqual({one.me.assigned for one in self.engagements().values()}, {uuid})
        self.team.services[name].vanish()
        heir, seconds = self.run_until_one_acts(3.0)
        self.assertEqual(heir, self.ranked()[0])
        self.assertLess(seconds, 3.0)
