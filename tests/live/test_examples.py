"""Tests of the examples, run as processes that communicate over the loopback interface."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import threading
from pathlib import Path

from twisted.trial.unittest import TestCase

from sim.demo.free_ports import find_free_ports

ROOT = Path(__file__).resolve().parent.parent.parent
PATIENCE = 30.0


def free_port() -> int:
    """Return an unused UDP port."""
    return find_free_ports("udp", "127.0.0.1", 1)[0]


class ExamplesTests(TestCase):
    """The examples in the documentation."""

    def start(self, name: str, *words: object) -> subprocess.Popen[str]:
        """Start an example; kill it after the test or a timeout."""
        process = subprocess.Popen(
            [sys.executable, str(ROOT / "examples" / f"{name}.py"), *map(str, words)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
        )
        watchdog = threading.Timer(PATIENCE, process.kill)
        watchdog.start()

        def end() -> None:
            watchdog.cancel()
            process.kill()
            process.communicate()

        self.addCleanup(end)
        return process

    def line(self, process: subprocess.Popen[str]) -> str:
        """Return the next line that a process prints, or an empty string at its end."""
        assert process.stdout is not None
        return process.stdout.readline().strip()

    def say(self, process: subprocess.Popen[str], text: str) -> None:
        """Send a line to a process."""
        assert process.stdin is not None
        process.stdin.write(text + "\n")
        process.stdin.flush()

    def test_readme(self) -> None:
        """The program in the README prints the value that its second node reads."""
        (program,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(encoding="utf-8"), re.DOTALL)
        command = [sys.executable, "-c", program]
        environment = {**os.environ, "PYTHONPATH": str(ROOT)}
        ran = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=PATIENCE, check=False)
        self.assertEqual((ran.stdout, ran.returncode), ("[b'red']\n", 0), ran.stderr)

    def test_keyvalue(self) -> None:
        """A process reads the value that another process stores."""
        first, second = free_port(), free_port()
        self.start("keyvalue", first)
        known = f"127.0.0.1:{first}"
        self.assertEqual(self.line(self.start("keyvalue", second, known, "colour", "red")), "stored on 2 nodes")
        self.assertEqual(self.line(self.start("keyvalue", free_port(), known, "colour")), "red")

    def test_chat(self) -> None:
        """Each of two chat programs prints the lines of the other program, without control characters."""
        first = free_port()
        ann = self.start("chat", "--port", first, "ann")
        self.assertEqual(self.line(ann), "here: ann")
        bob = self.start("chat", "--port", free_port(), "--known", f"127.0.0.1:{first}", "bob")
        self.assertEqual(self.line(bob), "here: ann bob")
        self.say(bob, "good morning")
        self.assertEqual(self.line(ann), "bob: good morning")
        self.say(ann, "hel\x1b[2Jlo")
        self.assertEqual(self.line(bob), "ann: hel [2Jlo")

    def test_workqueue(self) -> None:
        """All jobs are done even if a worker is killed during its first job."""
        # With this number of jobs the second worker has time to start, even on a loaded machine.
        first, jobs = free_port(), 30
        boss = self.start("workqueue", "--port", first, "boss", jobs)
        self.assertEqual(self.line(boss), f"jobs are put: {jobs}")
        known = ("--known", f"127.0.0.1:{first}")
        self.start("workqueue", "--port", free_port(), *known, "worker", "ann")
        lines = [self.line(boss)]
        mortal = self.start("workqueue", "--port", free_port(), *known, "worker", "bob", "--dies", "1.0")
        self.assertTrue(self.line(mortal).startswith("bob dies over"))
        lines += [self.line(boss) for _ in range(jobs - 1)]
        for number in range(jobs):
            self.assertTrue(any(line.startswith(f"{number} squared is {number**2}, says ann") for line in lines), lines)
