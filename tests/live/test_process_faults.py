"""Tests of ``middleware.faults.process`` with real processes: a frozen process continues, a killed process ends."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

from twisted.trial.unittest import SynchronousTestCase

ROOT = Path(__file__).parents[2]
FREEZE = """
import time
from middleware.faults.process import OwnProcess
began = time.monotonic()
OwnProcess().freeze(0.5)
print(time.monotonic() - began)
"""
KILL = """
from middleware.faults.process import OwnProcess
print('here', flush=True)
OwnProcess().kill()
print('still here')
"""


class OwnProcessTests(SynchronousTestCase):
    def run_program(self, program: str) -> subprocess.CompletedProcess[str]:
        """Run the program in a child process."""
        return subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, timeout=60)

    def test_freeze(self) -> None:
        """A frozen process executes nothing, and continues by itself after the given time."""
        child = self.run_program(FREEZE)
        self.assertEqual(child.returncode, 0, child.stderr)
        self.assertGreater(float(child.stdout), 0.45)

    def test_kill(self) -> None:
        """A killed process ends by SIGKILL without further output."""
        child = self.run_program(KILL)
        self.assertEqual((child.returncode, child.stdout), (-signal.SIGKILL, "here\n"))
