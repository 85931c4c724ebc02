"""Tests of ``swarm``: the command and its verbs."""

from __future__ import annotations

import contextlib
import io
import subprocess
import sys
from pathlib import Path

from twisted.trial.unittest import SynchronousTestCase

from swarmnode.command import RENAMED_VERBS, main

ROOT = Path(__file__).resolve().parents[2]


class CommandTests(SynchronousTestCase):
    def test_help_lists_the_verbs(self) -> None:
        """Without a verb, or with --help, the verbs are listed; an unknown verb gives one error line."""
        for words, code in (([], 0), (["--help"], 0), (["fly"], 2)):
            output, complaint = io.StringIO(), io.StringIO()
            with contextlib.redirect_stdout(output), contextlib.redirect_stderr(complaint):
                self.assertEqual(main(words), code)
            for verb in ("demo", "simulator", "trials", "deploy", "why", "dht", "tuple", "keyword", "rpc"):
                self.assertIn(verb, (complaint if code else output).getvalue())
        self.assertEqual((output.getvalue(), complaint.getvalue().count("\n")), ("", 1))
        self.assertIn("no verb 'fly'", complaint.getvalue())

    def test_each_verb_explains_itself(self) -> None:
        """Each verb has a help text."""
        for verb in ("demo", "simulator", "trials", "dht", "tuple", "keyword", "rpc"):
            output = io.StringIO()
            with contextlib.redirect_stdout(output), self.assertRaises(SystemExit) as caught:
                main([verb, "--help"])
            self.assertEqual(caught.exception.code, 0)
            self.assertIn("usage", output.getvalue())

    def test_renamed_verbs_are_accepted(self) -> None:
        """The old name of a verb runs the renamed one, after a warning with the new name."""
        for old, new in RENAMED_VERBS.items():
            output, complaint = io.StringIO(), io.StringIO()
            with contextlib.redirect_stdout(output), contextlib.redirect_stderr(complaint):
                self.assertRaises(SystemExit, main, [old, "--help"])
            self.assertIn(f"usage: swarm {new}", output.getvalue())
            self.assertIn(new, complaint.getvalue())

    def test_verb_without_its_libraries_names_the_extra(self) -> None:
        """A verb with missing libraries is rejected; the error contains the command that installs them."""
        hidden = "import sys; sys.modules['pymunk'] = None; from swarmnode.command import main"
        program = f"{hidden}; sys.exit(main(['trials']))"
        child = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, timeout=60)
        self.assertEqual(child.returncode, 2, child.stderr)
        self.assertEqual(child.stderr.count("\n"), 1, child.stderr)
        self.assertIn("pip install 'swarm-node[all]'", child.stderr)

    def test_help_of_a_node_verb_needs_no_twisted(self) -> None:
        """Verbs that query a running node print their help without importing Twisted or msgpack, to save time."""
        program = (
            "import sys\nfrom swarmnode import command as swarm\n"
            "try: swarm.main(['dht', '--help'])\n"
            "except SystemExit: pass\n"
            "sys.exit(any(name in sys.modules for name in ('twisted', 'msgpack', 'nacl')))"
        )
        child = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, timeout=60)
        self.assertEqual((child.returncode, child.stderr), (0, ""))
