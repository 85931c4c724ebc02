"""Tests of the data store with real processes: ``kill -9`` and a full disk lose no acknowledged record."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from twisted.trial.unittest import SynchronousTestCase

from benchmarks.store import run_kills

ROOT = Path(__file__).resolve().parents[2]
FAILING_DISK = """
import resource, signal, sys
from contextlib import suppress
from benchmarks.store import TTL_S, make_record
from middleware.entangled.errors import BadStore, Unwritable
from middleware.entangled.data.sqlite import SqliteStore

store = SqliteStore.open(sys.argv[1], 0.0)
store.put(make_record(1), TTL_S)
store.flush()
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, resource.RLIM_INFINITY))
number = 1
try:
    while True:
        number += 1
        store.put(make_record(number), TTL_S)
        if number % 20 == 0:
            with suppress(BadStore):
                store.flush(0.01)
except Unwritable as error:
    assert "cannot be written" in str(error), error
assert store.get_slot(make_record(1).slot) == make_record(1)
resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
store.flush(5.0)
assert store.put(make_record(number), TTL_S) and not store.write_error
store.close()
again = SqliteStore.open(sys.argv[1], 0.0)
assert [r.sequence for r in again.records()] == list(range(1, number + 1)), again.usage
print(number)
"""


class KillTest(SynchronousTestCase):
    def test_a_handful_of_kills(self) -> None:
        """A writer that is killed at any moment loses no acknowledged row and corrupts no data."""
        seen = run_kills(str(Path(self.mktemp()).resolve()), 6, seed=1)
        self.assertEqual((seen.lost, seen.damaged, seen.kills), ([], [], 6))
        self.assertGreater(seen.acknowledged, 0)


class FailingDiskTest(SynchronousTestCase):
    def test_lives_on(self) -> None:
        """While the operating system refuses writes, reads work and writes fail with the reason.

        Afterwards reads and writes work again.
        """
        path = str(Path(self.mktemp()).resolve())
        child = subprocess.run(
            [sys.executable, "-c", FAILING_DISK, path], cwd=ROOT, capture_output=True, text=True, timeout=60
        )
        self.assertEqual((child.returncode, child.stderr), (0, ""))
        self.assertGreater(int(child.stdout), 1)
