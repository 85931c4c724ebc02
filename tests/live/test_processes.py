"""Tests with real processes: the processes of a team end when their parent ends."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

from twisted.trial.unittest import SynchronousTestCase

from tests.live.until import until

ROOT = Path(__file__).resolve().parents[2]
CHILD = "import os, signal, sys; print(os.getpid(), *sys.argv[1:], flush=True); signal.pause()"
PARENT = """
import signal
import sys
# What runs the tests in the background may have told them to ignore it, and children inherit that.
signal.signal(signal.SIGINT, signal.default_int_handler)
from pathlib import Path
from twisted.internet import reactor
from sim.demo.processes import ProcessGroup
team = ProcessGroup(reactor, Path(sys.argv[1]), lambda name, line: print(line, flush=True))
for name in ("a", "b"):
    team.add(name, [sys.argv[2], name])
team.start()
reactor.addSystemEventTrigger("before", "shutdown", team.stop)
reactor.run()
"""
PATIENCE_S = 15.0


def is_alive(pid: int) -> bool:
    """Return whether a process with this id is running."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    # If no process collects orphans, ended processes stay in the table as zombies.
    try:
        return ") Z " not in Path(f"/proc/{pid}/stat").read_text(encoding="ascii", errors="replace")
    except OSError:
        return False


class OrphanTests(SynchronousTestCase):
    """Children end with their parent, however the parent ends."""

    def setUp(self) -> None:
        folder = Path(self.mktemp()).resolve()
        folder.mkdir()
        child = folder / "child.py"
        child.write_text(CHILD, encoding="utf-8")
        self.parent = subprocess.Popen(
            [sys.executable, "-c", PARENT, str(folder), str(child)], cwd=ROOT, stdout=subprocess.PIPE, text=True
        )
        assert self.parent.stdout is not None
        self.addCleanup(self.parent.stdout.close)
        self.addCleanup(self.parent.kill)
        lines = [self.parent.stdout.readline().split() for _ in range(2)]
        self.pids = [int(line[0]) for line in lines]
        self.assertEqual(sorted(line[1] for line in lines), ["a", "b"])

    def assert_ended(self) -> None:
        """Wait until no child is running; fail after a timeout."""
        until(lambda: not any(map(is_alive, self.pids)), told=lambda: list(filter(is_alive, self.pids)))

    def test_killed_parent_leaves_no_orphan(self) -> None:
        """If the parent is killed by SIGKILL, its children end."""
        self.parent.kill()
        self.parent.wait(PATIENCE_S)
        self.assert_ended()

    def test_interrupted_parent_ends_its_children_first(self) -> None:
        """If the parent is interrupted (Ctrl-C), its children end first."""
        self.parent.send_signal(signal.SIGINT)
        self.parent.wait(PATIENCE_S)
        self.assert_ended()
