"""Tests of ``swarmnode.sandbox``: the libraries that are imported before the process drops its rights."""

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
        """Only listed libraries that a source imports at the beginning of a line are imported."""
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
        """Bytes that are not Python result in no imports, in linear time."""
        for source in (
            b"",
            b"\xff" * 1000,
            b"import " * 30_000,
            b"from " + b"." * 100_000,
            b"import a" + b", a" * 90_000,
        ):
            self.assertEqual(find_allowed_imports(source), [])
