"""Tests of a closed team of real processes: a second node joins it by code over UDP and is later revoked."""

from __future__ import annotations

import json
from typing import Any

from sim.demo.free_ports import find_free_ports
from tests.live.node import PATIENCE_S, NodeCase


class ClosedTeamTests(NodeCase):
    def told(self, *words: str, code: int = 0) -> Any:
        """Return the result of ``swarm WORDS --json``, or its error output if it fails with the exit code ``code``."""
        done = self.swarm(*words, "--json")
        self.assertEqual(done.returncode, code, done.stderr)
        return json.loads(done.stdout) if code == 0 else done.stderr

    def test_made_joined_and_left(self) -> None:
        """Four commands create a team of two; a used join code and a revoked member are refused with the reason."""
        [port] = find_free_ports("udp", "127.0.0.1", 1)
        team = self.told("init", "yard", "--first", "vaio", "--at", f"127.0.0.1:{port}")
        self.node("--config", team["settings"]).says("vaio joined")
        invited = self.told("invite", "dog9")
        found = self.told("join", invited["text"], "--folder", "dog9")
        self.assertEqual((found["team"], found["name"]), ("yard", "dog9"))
        self.assertIn("was used as often", self.told("join", invited["text"], "--folder", "thief", code=1))
        dog = self.node("--config", found["settings"])
        dog.says("dog9 joined")
        members = self.told("members", "--node", "vaio")["members"]
        self.assertEqual([(each["name"], bool(each["at"])) for each in members], [("dog9", True), ("vaio", True)])
        self.told("rotate", "--node", "vaio")
        self.told("revoke", "dog9", "--node", "vaio")
        dog.says("revoked")
        self.assertEqual([each["name"] for each in self.told("members", "--node", "vaio")["members"]], ["vaio"])
        (self.folder / "dog9" / "swarm.membership").chmod(0o644)
        again = self.node("--config", found["settings"])
        again.process.wait(PATIENCE_S)
        again.says("chmod 600")
