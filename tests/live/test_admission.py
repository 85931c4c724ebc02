"""A closed team of real processes: made, joined by a code over UDP, and left again."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
import threading
from pathlib import Path
from typing import Any

from twisted.trial.unittest import SynchronousTestCase

from sim.demo.port import free
from tests.live.until import until

ROOT = Path(__file__).resolve().parents[2]
PATIENCE_S = 30.0


class ClosedTeamTests(SynchronousTestCase):
    def setUp(self) -> None:
        # Trial's own folders are deeper than the path of a socket may be.
        self.folder = Path(tempfile.mkdtemp())
        self.addCleanup(shutil.rmtree, self.folder)
        inherited = {name: value for name, value in os.environ.items() if not name.startswith("SWARM_")}
        here = {"XDG_RUNTIME_DIR": str(self.folder), "XDG_CONFIG_HOME": str(self.folder / "config")}
        self.environment = {**inherited, **here, "PYTHONPATH": str(ROOT), "PYTHONUNBUFFERED": "1"}
        self.lines: dict[str, list[str]] = {}

    def start(self, settings: str, name: str) -> subprocess.Popen[str]:
        """A node with that settings file."""
        twistd = str(Path(sys.executable).parent / "twistd")
        child = subprocess.Popen(
            [sys.executable, twistd, "-n", "--pidfile=", "swarm-node", "--config", settings],
            cwd=self.folder,
            env=self.environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        self.addCleanup(child.wait)
        self.addCleanup(child.kill)
        lines = self.lines[name] = []
        assert child.stdout is not None
        reader = threading.Thread(target=lines.extend, args=(child.stdout,), daemon=True)
        reader.start()
        self.addCleanup(child.stdout.close)
        self.addCleanup(reader.join)
        self.addCleanup(child.kill)
        return child

    def said(self, name: str, words: str) -> bool:
        """Whether a node's log has these words."""
        return any(words in line for line in list(self.lines[name]))

    def swarm(self, *words: str, code: int = 0) -> Any:
        """What ``swarm WORDS --json`` answers; where it is refused, what it complains of."""
        program = "import sys; from swarmnode.command import main; sys.exit(main(sys.argv[1:]))"
        done = subprocess.run(
            [sys.executable, "-c", program, *words, "--json"],
            cwd=self.folder,
            env=self.environment,
            capture_output=True,
            text=True,
            timeout=60,
        )
        self.assertEqual(done.returncode, code, done.stderr)
        return json.loads(done.stdout) if code == 0 else done.stderr

    def test_made_joined_and_left(self) -> None:
        """From nothing to a team of two by four commands; a used code and a revoked member are refused by name."""
        [port] = free("udp", "127.0.0.1", 1)
        team = self.swarm("init", "yard", "--first", "vaio", "--at", f"127.0.0.1:{port}")
        self.start(team["settings"], "vaio")
        until(lambda: self.said("vaio", "vaio joined"), told=lambda: self.lines)
        invited = self.swarm("invite", "dog9")
        found = self.swarm("join", invited["text"], "--folder", "dog9")
        self.assertEqual((found["team"], found["name"]), ("yard", "dog9"))
        self.assertIn("was used as often", self.swarm("join", invited["text"], "--folder", "thief", code=1))
        self.start(found["settings"], "dog9")
        until(lambda: self.said("dog9", "dog9 joined"), told=lambda: self.lines)
        members = self.swarm("members", "--node", "vaio")["members"]
        self.assertEqual([(each["name"], bool(each["at"])) for each in members], [("dog9", True), ("vaio", True)])
        self.swarm("rotate", "--node", "vaio")
        self.swarm("revoke", "dog9", "--node", "vaio")
        until(lambda: self.said("dog9", "revoked"), told=lambda: self.lines)
        self.assertEqual([each["name"] for each in self.swarm("members", "--node", "vaio")["members"]], ["vaio"])
        (self.folder / "dog9" / "swarm.membership").chmod(0o644)
        again = self.start(found["settings"], "again")
        again.wait(PATIENCE_S)
        until(lambda: self.said("again", "chmod 600"), told=lambda: self.lines)
