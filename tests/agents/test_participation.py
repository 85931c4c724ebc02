"""Tests of ``agents.participation``: the council of a task survives the successive failure of its members."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from twisted.internet.defer import Deferred
from twisted.trial.unittest import SynchronousTestCase

from agents.catalogue import create_task
from agents.participation import COUNCIL_CHECK_S, SUCCESSOR_RETRY_S
from middleware.consensus.lease.charter import create_charter
from middleware.entangled.record import Record
from middleware.tasks.council_manager import SILENT_S
from middleware.tasks.order import PAUSE, RESUME, Order
from middleware.tasks.task import COMPLETED, TASKS, Task, find_outcome, parse_tasks, with_newest_council
from swarmnode.simulated_team import SimulatedTeam

OTHERS = ("witness1", "witness2", "witness3")
LATEST = SILENT_S + SUCCESSOR_RETRY_S + COUNCIL_CHECK_S + 2.0
"""The time in seconds within which a silent member is replaced."""
TURNS = 60.0


class CouncilMaintainerTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.made(SimulatedTeam(3, 0.1, others=OTHERS))

    def made(self, team: SimulatedTeam) -> None:
        """Use ``team`` in this test."""
        self.team = team
        self.addCleanup(self.team.stop)
        self.node = self.team.services[SimulatedTeam.BOOTSTRAP].assembly.node
        self.records: list[Record] = []
        self.group: list[Record] = []
        self.node.watch_tasks(lambda records: self.records.__setitem__(slice(None), records))
        self.node.watch_group("turn", lambda records: self.group.__setitem__(slice(None), records))

    def given(self, *council: str, turns: float = TURNS) -> None:
        """Write a long task ``turn_around`` with these nodes as its council."""
        task = replace(create_task("turn-around", "turn", 0.0), waiting_period=1.0, parameters={"turns": turns})
        members = tuple(self.team.services[name].assembly.node.entangled.contact for name in council)
        task = task.with_council(create_charter(self.node.entangled.identity, "turn", members))
        put = self.node.entangled.put(TASKS, "turn", task.pack(), "team")
        self.team.clock.advance(0.5)
        self.successResultOf(put)

    @property
    def task(self) -> Task:
        """Return the task with its newest council."""
        return with_newest_council(parse_tasks(self.records)["turn"], self.group)

    @property
    def council(self) -> list[str]:
        """Return the sorted names of the members of the task's council."""
        names = {service.assembly.node.uuid: name for name, service in self.team.services.items()}
        return sorted(names[member.node_id.hex()] for member in self.task.council)

    def moving(self) -> list[str]:
        """Return the names of the dogs that move."""
        return [name for name, dog in self.team.simulator.world.dogs.items() if dog.is_moving]

    def run_for(self, seconds: float) -> None:
        """Advance the time in steps; check after each step that at most one dog moves."""
        end = self.team.clock.seconds() + seconds
        while self.team.clock.seconds() < end:
            self.team.clock.advance(0.05)
            self.assertLessEqual(len(self.moving()), 1)

    def test_who_acts_fills_the_council(self) -> None:
        """The acting agent replaces dead council members and continues.

        If the agent itself fails, another completes the task.
        """
        self.given("witness1", "witness2", "dog1", turns=12.0)
        self.run_for(3.0)
        (first,) = self.moving()
        gone = "witness1"
        self.team.kill(gone)
        self.run_for(LATEST)
        self.assertEqual((self.task.configuration, len(self.council), self.moving()), (2, 3, [first]))
        self.assertNotIn(gone, self.council)
        for gone in ("witness2", first):
            self.team.kill(gone)
            self.run_for(LATEST)
            self.assertNotIn(gone, self.council)
        outcome = find_outcome(self.task, self.group)
        while outcome is None and self.team.clock.seconds() < 400.0:
            self.run_for(5.0)
            outcome = find_outcome(self.task, self.group)
        assert outcome is not None
        self.assertEqual(outcome.outcome, COMPLETED)
        self.assertNotEqual(outcome.by, first)

    def test_before_anybody_acts(self) -> None:
        """Two council members fail one after the other during a pause; after the resume exactly one dog acts."""
        self.given("witness1", "witness2", "witness3")
        self.successResultOf(self.ordered(PAUSE))
        self.run_for(2.0)
        for gone in ("witness1", "witness2"):
            self.team.kill(gone)
            self.run_for(LATEST)
        self.successResultOf(self.ordered(RESUME))
        self.run_for(3.0)
        self.assertEqual(len(self.moving()), 1)

    def test_nobody_to_follow(self) -> None:
        """If no node can replace a failed member, the council stays unchanged; the acting agent is not interrupted."""
        self.made(SimulatedTeam(4, 0.1, dogs=("dog1", "dog2")))
        self.given("vaio", "dog1", "dog2")
        self.run_for(3.0)
        (first,) = self.moving()
        self.team.kill("dog1" if first == "dog2" else "dog2")
        self.run_for(LATEST)
        self.assertEqual((self.task.configuration, self.moving()), (1, [first]))

    def ordered(self, word: str) -> Deferred[Any]:
        """Write a pause or resume order."""
        done = self.node.record_order("turn", Order(word, "test", 0.0).pack())
        self.team.clock.advance(0.5)
        return done
