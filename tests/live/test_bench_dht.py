"""Tests of the comparison of peer-to-peer libraries: a small run of this library with real processes and sockets."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from pathlib import Path

from twisted.trial.unittest import SynchronousTestCase

ROOT = Path(__file__).resolve().parent.parent.parent
LIMIT_S = 60.0


class BenchDhtTests(SynchronousTestCase):
    """Behaviour of ``python -m benchmarks.dht``."""

    def setUp(self) -> None:
        folder = tempfile.TemporaryDirectory()
        self.addCleanup(folder.cleanup)
        self.folder = Path(folder.name)

    def bench(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        """Run the benchmark."""
        command = [sys.executable, "-m", "benchmarks.dht", *arguments]
        return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=LIMIT_S)

    def test_three_nodes_are_measured(self) -> None:
        """Three nodes join, store and find all values; the table, the JSON file and the figure are written."""
        out, plot = self.folder / "out.json", self.folder / "plot.svg"
        small = ["--nodes", "3", "--peers", "swarm", "--seconds", "0.3", "--out", str(out), "--plot", str(plot)]
        ran = self.bench(*small)
        self.assertEqual(ran.returncode, 0, ran.stderr)
        results = json.loads(out.read_text())["results"]["3"]
        self.assertEqual(list(results), ["swarm-sqlite", "swarm-crash", "swarm-memory"])
        for result in results.values():
            self.assertNotIn("singles", result.get("trouble", {}), ran.stdout)
            self.assertNotIn("join", result.get("trouble", {}), ran.stdout)
            done = [(result[kind]["tried"] > 0, result[kind]["failed"]) for kind in ("put", "get", "puts", "gets")]
            self.assertEqual(done, [(True, 0)] * 4, ran.stdout)
            self.assertNotIn(None, result["join_ms"])
            self.assertEqual(result["watch"]["lost"], 0)
        self.assertIn("sealed, SQLite", ran.stdout)
        self.assertIn("durable put", ran.stdout)
        self.assertIn("swarm-memory", plot.read_text())

    def test_an_unknown_peer_is_refused(self) -> None:
        """An unknown library is refused with one line that lists the known libraries."""
        ran = self.bench("--peers", "gnutella")
        self.assertEqual(ran.returncode, 2)
        self.assertIn("gnutella is unknown; choose from swarm-sqlite", ran.stderr)
