"""Tests of what a team leaves behind whose tasks name a strategy of somebody else: no process."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from twisted.internet.defer import Deferred
from twisted.trial.unittest import SynchronousTestCase

from middleware.consensus.selection import Strategies
from middleware.consensus.strategy import Report
from middleware.consensus.worker import Worker
from middleware.errors import UnknownStrategy
from middleware.tasks.task import Task
from swarmnode.rehearsal import VirtualTeam

ROOT = str(Path(__file__).resolve().parents[2])
MODULE = "from middleware.consensus.strategies.nearest import Nearest\n\n\nclass Spare(Nearest):\n    name = 'spare'\n"
ENTRY = "[swarm_node.strategies]\nspare = spare_of_tests:Spare\n"


class StrategiesTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.installed()
        self.processes: list[subprocess.Popen[bytes]] = []
        start = Worker._start

        def started(worker: Worker) -> None:
            start(worker)
            assert worker._process is not None
            self.processes.append(worker._process)
            self.addCleanup(worker._process.wait)
            self.addCleanup(worker._process.kill)

        self.patch(Worker, "_start", started)

    def installed(self) -> None:
        """Have the entry point "spare" on this process's path for imports, as pip would."""
        folder = Path(self.mktemp()).resolve()
        (folder / "spare-1.dist-info").mkdir(parents=True)
        (folder / "spare_of_tests.py").write_text(MODULE)
        (folder / "spare-1.dist-info" / "METADATA").write_text("Name: spare\nVersion: 1\n")
        (folder / "spare-1.dist-info" / "entry_points.txt").write_text(ENTRY)
        self.patch(sys, "path", [str(folder), ROOT, *sys.path])

    def submit(self, team: VirtualTeam, task_id: str) -> None:
        """Have the dogs do a task that "spare" decides."""
        task = Task(task_id, "turn-around", "Odd", strategy="spare", created=team.clock.seconds())
        submitted = Deferred.fromCoroutine(team.services["vaio"].assembly.node.submit(task))
        team.clock.advance(10.0)
        self.assertEqual(self.successResultOf(submitted).task_id, task_id)
        states = {each["id"]: each["status"] for each in team.state()["tasks"]}
        self.assertEqual(states[task_id], "COMPLETED")

    @property
    def alive(self) -> int:
        """How many of the processes run."""
        return sum(process.poll() is None for process in self.processes)

    def test_node_has_one_process_and_ends_it(self) -> None:
        """Each node has one process for all tasks of a strategy; it ends with its node, also when the power fails."""
        team = VirtualTeam(11, dogs=("dog1", "dog2"))
        self.addCleanup(self.flushLoggedErrors)  # a strategy that is still being loaded is logged
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
        """Who asks for a strategy of somebody else when the node has left is refused, or hears the fallback."""
        early, late = Strategies(), Strategies()
        guard = early.named("spare", {})
        self.assertIs(early.named("spare", {}), guard)
        early.stop()
        late.stop()
        self.assertIn("it was stopped", early.named("spare", {}).find([Report("a", 1.0)]).reason)
        error = self.assertRaises(UnknownStrategy, late.named, "spare", {})
        self.assertIn("the node has stopped", str(error))
        self.assertEqual((len(self.processes), self.alive), (1, 0))
        self.flushLoggedErrors()
