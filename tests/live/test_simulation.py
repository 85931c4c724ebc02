"""Tests of the ``sim`` command as a process: equal hashes, and a clean exit."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

from twisted.trial.unittest import SynchronousTestCase

ROOT = Path(__file__).resolve().parent.parent.parent
SCENARIO = """
about = "some of everything"
nodes = 12
seconds = 20.0
repair = 5.0
[join]
how = "at once"
settle = 1.0
[link]
kind = "internet"
loss = 0.05
burst = 0.05
duplicate = 0.02
reorder = 0.05
[sessions]
kind = "weibull"
median = 60.0
[clocks]
drift = 0.01
[[fault]]
kind = "freeze"
at = 2.0
count = 2
lasts = 3.0
[[fault]]
kind = "cut"
at = 6.0
share = 0.4
lasts = 4.0
[load.standing]
"""


class SimulationTests(SynchronousTestCase):
    """Tests of ``sim run``."""

    def setUp(self) -> None:
        """Write a scenario."""
        self.folder = Path(self.mktemp()).resolve()
        self.folder.mkdir()
        self.scenario = self.folder / "some.toml"
        self.scenario.write_text(SCENARIO)

    def begun(self, hash_seed: int, *words: str) -> subprocess.Popen[str]:
        """Start the command; ``PYTHONHASHSEED`` is this hash seed."""
        return subprocess.Popen(
            [sys.executable, "-m", "swarmnode.simulation", "run", "--scenario", str(self.scenario), *words],
            cwd=ROOT,
            env={**os.environ, "PYTHONHASHSEED": str(hash_seed)},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

    def test_hash_is_the_same_in_every_process(self) -> None:
        """The same seed gives the same hash for each PYTHONHASHSEED; a different seed gives a different hash."""
        runs = [self.begun(1, "--seed", "4"), self.begun(2, "--seed", "4"), self.begun(2, "--seed", "5")]
        hashes = []
        for process in runs:
            out, err = process.communicate(timeout=100)
            self.assertIn(process.returncode, (0, 1), err)
            hashes.append(next(line for line in out.splitlines() if line.startswith("hash")))
        self.assertEqual(hashes[0], hashes[1])
        self.assertNotEqual(hashes[0], hashes[2])

    def test_interrupt_leaves_a_report(self) -> None:
        """After SIGINT the command ends with a JSON report that is marked as partial."""
        report = self.folder / "r.json"
        process = self.begun(1, "--nodes", "2000", "--json", str(report))
        while not report.exists():  # the file is opened at the start of the run
            self.assertIsNone(process.poll())
            os.sched_yield()
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=100)
        self.assertEqual(process.returncode, 130, err)
        self.assertIn("PARTIAL", out)
        self.assertTrue(json.loads(report.read_text())["partial"])

    def test_bad_input_is_one_line(self) -> None:
        """An invalid scenario is refused with its line number and exit code 2."""
        self.scenario.write_text("about = 'x'\nnodes = -3\n")
        process = self.begun(1)
        out, err = process.communicate(timeout=100)
        self.assertEqual((process.returncode, out), (2, ""))
        self.assertTrue(err.startswith(f"sim run: {self.scenario}:2: nodes: is -3; write "), err)
