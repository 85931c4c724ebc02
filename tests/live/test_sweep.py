"""Tests of long runs as processes: continuation after an interrupt, and equal results on several machines."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

from twisted.trial.unittest import SkipTest, TestCase

from sim.team import seed_log
from tests.invariants.run import run, run_all

ROOT = Path(__file__).resolve().parents[2]


class InterruptTests(TestCase):
    def command(self, count: int, book: str) -> subprocess.Popen[str]:
        """Start a process that runs many short schedules with a seed log."""
        words = ["--schedules", str(count), "--only", "leases", "--jobs", "1", "--log", book, "--resume"]
        command = [sys.executable, "-m", "tests.invariants", *words]
        return subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)

    def test_interrupted(self) -> None:
        """After Ctrl-C the seed log contains the completed schedules.

        The next call runs only the remaining schedules.
        """
        book = os.path.abspath(self.mktemp())
        with self.command(100_000, book) as child:
            assert child.stdout is not None
            self.assertIn("from seed 1", child.stdout.readline())
            child.send_signal(signal.SIGINT)
            told, _ = child.communicate(timeout=60)
            self.assertEqual(child.returncode, 130, told)
        (first,) = seed_log.parse_entries(Path(book).read_text(), book)
        self.assertGreater(first.count, 0)
        with self.command(first.count + 3, book) as child:
            told, _ = child.communicate(timeout=120)
            self.assertEqual(child.returncode, 0, told)
        second = seed_log.parse_entries(Path(book).read_text(), book)[1]
        self.assertEqual((second.first, second.count, second.failures), (first.count + 1, 3, ()))


class MachinesTests(TestCase):
    def test_workers(self) -> None:
        """The workers of a scheduler give the same outcomes in the same order as this process."""
        try:
            from distributed import LocalCluster
        except ImportError:
            raise SkipTest(
                "DASK IS MISSING, sweeps over several machines are NOT tested: install the extra sweep"
            ) from None
        cluster = LocalCluster(n_workers=2, threads_per_worker=1, host="127.0.0.1", dashboard_address=None)
        try:
            outcomes = list(run_all(range(1, 7), 1, ("leases",), scheduler=cluster.scheduler_address))
        finally:
            cluster.close()
        self.assertEqual(outcomes, [run(seed, ("leases",)) for seed in range(1, 7)])
