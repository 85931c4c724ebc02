"""Tests that no process is left running when a team that used strategies from other Python packages has ended."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from twisted.internet.defer import Deferred
from twisted.trial.unittest import SynchronousTestCase

from middleware.consensus.process_strategy import ProcessStrategy
from middleware.consensus.strategy import Report
from middleware.consensus.strategy_registry import StrategyRegistry
from middleware.errors import UnknownStrategy
from middleware.tasks.task import Task
from swarmnode.simulated_team import SimulatedTeam

ROOT = str(Path(__file__).resolve().parents[2])
MODULE = "from middleware.consensus.strategies.nearest import Nearest\n\n\nclass Spare(Nearest):\n    name = 'spare'\n"
ENTRY = "[swarm_node.strategies]\nspare = spare_of_tests:Spare\n"


class StrategiesTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.installed()
        self.processes: list[subprocess.Popen[bytes]] = []
        start = ProcessStrategy._start

        def started(worker: ProcessStrategy) -> None:
            start(worker)
            assert worker._process is not None
            self.processes.append(worker._process)
            self.addCleanup(worker._process.wait)
            self.addCleanup(worker._process.kill)

        self.patch(ProcessStrategy, "_start", started)

    def installed(self) -> None:
        """Add the entry point "spare" to the path of this process, as pip does."""
        folder = Path(self.mktemp()).resolve()
        (folder / "spare-1.dist-info").mkdir(parents=True)
        (folder / "spare_of_tests.py").write_text(MODULE)
        (folder / "spare-1.dist-info" / "METADATA").write_text("Name: spare\nVersion: 1\n")
        (folder / "spare-1.dist-info" / "entry_points.txt").write_text(ENTRY)
        self.patch(sys, "path", [str(folder), ROOT, *sys.path])

    def submit(self, team: SimulatedTeam, task_id: str) -> None:
        """Submit a task with the strategy "spare"; check that the task completes."""
        task = Task(task_id, "turn-around", "Odd", strategy="spare", created=team.clock.seconds())
        submitted = Deferred.fromCoroutine(team.services["vaio"].assembly.node.submit(task))
        team.clock.advance(10.0)
        self.assertEqual(self.successResultOf(submitted).task_id, task_id)
        states = {each["id"]: each["status"] for each in team.state()["tasks"]}
        self.assertEqual(states[task_id], "COMPLETED")

    @property
    def alive(self) -> int:
        """Return the number of running processes."""
        return sum(process.poll() is None for process in self.processes)

    def test_node_has_one_process_and_ends_it(self) -> None:
        """Each node has one process per strategy for all tasks; this process ends with the node, even after a crash."""
        team = SimulatedTeam(11, dogs=("dog1", "dog2"))
        self.addCleanup(self.flushLoggedErrors)  # the node logs an error while the strategy is still loading
        self.addCleanup(team.stop)
        self.submit(team, "t1")
        self.submit(team, "t2")
        self.assertEqual(self.alive, 3)
        team.services["dog1"].stopService()
        team.clock.advance(1.0)
        self.assertEqual(self.alive, 2)
        team.kill("dog2")
        self.assertEqual(self.alive, 1)
        team.stop()
        self.assertEqual(self.alive, 0)

    def test_nothing_begins_after_the_end(self) -> None:
        """After the end of a node, a strategy from another package starts no process.

        The strategy is refused, or replaced by the fallback.
        """
        early, late = StrategyRegistry(), StrategyRegistry()
        guard = early.get("spare", {})
        self.assertIs(early.get("spare", {}), guard)
        early.stop()
        late.stop()
        self.assertIn("the strategy was stopped", early.get("spare", {}).find([Report("a", 1.0)]).reason)
        error = self.assertRaises(UnknownStrategy, late.get, "spare", {})
        self.assertIn("the node has stopped", str(error))
        self.assertEqual((len(self.processes), self.alive), (1, 0))
        self.flushLoggedErrors()
