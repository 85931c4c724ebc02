"""Tests of ``swarmnode.sandbox``: the libraries that are imported before the process gives up its rights."""

from __future__ import annotations

from twisted.trial.unittest import SynchronousTestCase

from swarmnode.sandbox import find_allowed_imports

SOURCE = b"""
from __future__ import annotations
import math, numpy as np, os
import subprocess
import agents.motion
from collections.abc import Sequence
from middleware.consensus.strategies.nearest import Nearest
from swarmnode.plugin import Options
def late():
    import statistics
text = "import json"
"""


class SandboxTests(SynchronousTestCase):
    def test_only_listed_libraries_are_imported(self) -> None:
        """Of the libraries that a source imports at the beginning of a line, only permitted libraries are preloaded."""
        self.assertEqual(
            find_allowed_imports(SOURCE),
            [
                *(
                    "agents.motion",
                    "collections.abc",
                    "math",
                    "middleware.consensus.strategies.nearest",
                    "numpy",
                    "numpy.fft",
                ),
                *("numpy.random", "statistics"),
            ],
        )

    def test_any_bytes(self) -> None:
        """Bytes that are not Python give no imports, and take linear time."""
        for source in (
            b"",
            b"\xff" * 1000,
            b"import " * 30_000,
            b"from " + b"." * 100_000,
            b"import a" + b", a" * 90_000,
        ):
            self.assertEqual(find_allowed_imports(source), [])
