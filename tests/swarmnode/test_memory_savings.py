"""Tests of ``swarmnode.memory_savings``: processes without TLS do not import pyOpenSSL, even if it is installed."""

from __future__ import annotations

import gc
import os
import subprocess
import sys
from pathlib import Path

from twisted.trial.unittest import SynchronousTestCase

from swarmnode.memory_savings import release_memory

ROOT = Path(__file__).resolve().parents[2]
LOADED = "pyOpenSSL is loaded"
NODE = """
import sys
from twisted.scripts.twistd import ServerOptions
options = ServerOptions()
options.parseOptions(["-n", "swarm-node", "--name", "a", *sys.argv[1:]])
options.subOptions
from twisted.internet import reactor
"""


class MemorySavingsTests(SynchronousTestCase):
    def said(self, *words: str) -> str:
        """Run Python with a stub of pyOpenSSL that prints a line when it is imported; return the output."""
        folder = Path(self.mktemp()) / "OpenSSL"
        folder.mkdir(parents=True)
        text = f"print({LOADED!r})\nraise ImportError('it is none')\n"
        (folder / "__init__.py").write_text(text, encoding="utf-8")
        path = os.pathsep.join((str(folder.parent.resolve()), str(ROOT)))
        child = subprocess.run(
            [sys.executable, *words],
            cwd=ROOT,
            capture_output=True,
            text=True,
            timeout=60,
            env={**os.environ, "PYTHONPATH": path},
        )
        return child.stdout + child.stderr

    def test_load_nothing_for_plain_nodes(self) -> None:
        """A node without TLS does not import pyOpenSSL, even if it serves the page."""
        for roles in ("edge", "edge,web"):
            told = self.said("-c", NODE, "--roles", roles)
            self.assertEqual(told, "", roles)

    def test_load_it_for_tls(self) -> None:
        """A node that serves the page over TLS imports pyOpenSSL."""
        self.assertIn(LOADED, self.said("-c", NODE, "--roles", "web", "--web-tls", "auto"))

    def test_load_nothing_for_commands(self) -> None:
        """The demonstration, the simulator and other commands do not import pyOpenSSL."""
        nowhere = ("--host", "203.0.113.1")
        for words in (("-m", "sim.demo", "--help"), ("-m", "sim.robots.server", *nowhere)):
            told = self.said(*words)
            self.assertNotIn(LOADED, told)
            self.assertNotIn("Traceback", told)
        for verb in (("demo", "--help"), ("trials", "--help"), ("simulator", *nowhere)):
            told = self.said("-c", f"from swarmnode.command import main; main({list(verb)!r})")
            self.assertNotIn(LOADED, told)
            self.assertNotIn("Traceback", told)

    def test_look_at_what_is_new_only(self) -> None:
        """After ``release_memory`` the garbage collector skips objects created earlier, and checks newer objects."""
        self.addCleanup(gc.unfreeze)
        before: list[object] = [[]]
        release_memory()
        after: list[object] = [[]]
        looked_at = {id(each) for each in gc.get_objects()}
        self.assertNotIn(id(before), looked_at)
        self.assertIn(id(after), looked_at)
