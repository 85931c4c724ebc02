"""Run a program in several processes, and check that the program's output does not depend on the order of sets."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from twisted.trial.unittest import SynchronousTestCase

ROOT = Path(__file__).resolve().parents[1]
HASH_SEEDS = "1", "4242"
LIMIT_S = 300


def replayed(case: SynchronousTestCase, program: str) -> str:
    """Return the output of ``program``; fail ``case`` unless the output is the same for different hash seeds."""
    printed = set()
    for hash_seed in HASH_SEEDS:
        child = subprocess.run(
            [sys.executable, "-c", program],
            cwd=ROOT,
            env={**os.environ, "PYTHONHASHSEED": hash_seed},
            capture_output=True,
            text=True,
            timeout=LIMIT_S,
        )
        case.assertEqual((child.returncode, child.stderr), (0, ""))
        printed.add(child.stdout.strip())
    case.assertEqual(len(printed), 1, printed)
    return printed.pop()
