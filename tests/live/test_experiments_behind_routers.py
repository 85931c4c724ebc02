"""Tests of both experiments of the thesis with dogs behind routers: a run of ``make demo NAT=1``."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

from sim.namespaces.capture import find_words
from sim.namespaces.capture import read_datagrams as datagrams_of
from sim.namespaces.internet import ROOT
from tests.live.namespaces import NamespaceCase

LIMIT_S = 400.0
WORDS = (b"red target", b"EXECUTING", b"capabilities", b"camera")
"""Words that the team sends.  Shorter words could occur by chance in six million random bytes."""


class ExperimentsBehindRoutersTests(NamespaceCase):
    """dog1 is behind a port restricted router, dog2 behind a symmetric router.

    dog3 is on the LAN of the bootstrap node.
    """

    def test_both_experiments_hold(self) -> None:
        """The nearest dog acts, and after its failure another dog, as the page shows.

        A capture contains no plain text.
        """
        folder = Path(self.mktemp()).absolute()
        report = folder.parent / "report.json"
        folder.parent.mkdir(parents=True, exist_ok=True)
        command = [sys.executable, "-m", "sim.namespaces.demo", "--robot", "sim", "--run-dir", str(folder)]
        record = folder.parent / "wide.pcap"
        command += ["--report", str(report), "--record", str(record)]
        ran = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=LIMIT_S)
        self.assertEqual(ran.returncode, 0, ran.stdout + ran.stderr)
        verdicts = json.loads(report.read_text())
        self.assertIn("takeover", json.dumps(verdicts))
        self.assertEqual(ran.stdout.count("PASS"), 2, ran.stdout)
        # The page was requested without TLS and its words are in the capture, so the search finds plain text.
        self.assertEqual(find_words(record.read_bytes(), WORDS), list(WORDS))
        datagrams = [held for _, _, held in datagrams_of(record)]
        self.assertGreater(len(datagrams), 500)
        self.assertEqual(find_words(b"\n".join(datagrams), WORDS), [])
