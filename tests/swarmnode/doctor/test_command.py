"""Tests of ``swarm doctor``: its requests, output and exit codes."""

from __future__ import annotations

import contextlib
import io
import json
import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from twisted.trial.unittest import SynchronousTestCase

from middleware.config.settings import Settings
from middleware.entangled.control.socket_path import FOLDER_NAME, SUFFIX
from swarmnode.doctor.command import main
from swarmnode.doctor.facts import Facts, Health
from tests.swarmnode.doctor.test_diagnosis import WELL

HEALTH = {
    "id": "ab" * 20,
    "address": "192.168.1.7:8484",
    "contacts": 1,
    "rows": 1,
    "max_rows": 100,
    "bytes": 1,
    "max_bytes": 100,
    "trouble": "",
    "refusals": [],
}
LINKS = [
    {"id": "cd" * 20, "address": "192.168.1.9:8484", "relayed": False, "times": [0.002] * 10},
    {"id": "ef" * 20, "address": "~ef:1", "relayed": True, "times": [None] * 10},
]


class CommandTests(SynchronousTestCase):
    """Tests of the command ``swarm doctor``."""

    def setUp(self) -> None:
        self.folder = Path(self.mktemp()).absolute()
        (self.folder / FOLDER_NAME).mkdir(mode=0o700, parents=True)
        self.patch(os, "environ", {**os.environ, "XDG_RUNTIME_DIR": str(self.folder)})
        self.settings = self.folder / "dog1.toml"
        self.settings.write_text('[node]\nname = "dog1"\nteam_key = "k"\n', encoding="utf-8")
        self.health: dict[str, Any] = HEALTH
        self.facts = WELL
        self.measured: list[tuple[str, bool, Health | None]] = []

    def runs(self, name: str) -> None:
        """Create the control socket's file for a running node of that name."""
        (self.folder / FOLDER_NAME / f"{name}{SUFFIX}").touch()

    def ask(self, path: Path, request: dict[str, Any]) -> Iterator[dict[str, Any]]:
        """Return the reply of a running node."""
        yield {"answer": self.health if request["verb"] == "health" else LINKS}

    def measure(self, settings: Settings, is_running: bool, health: Health | None) -> Facts:
        """Return the prepared facts instead of measured facts."""
        self.measured.append((settings.node.name, is_running, health))
        return replace(self.facts, health=health, is_running=is_running)

    def run_it(self, *words: str) -> tuple[int, str, str]:
        """Run the command; return exit code, standard output and standard error."""
        out, errors = io.StringIO(), io.StringIO()
        with contextlib.redirect_stderr(errors):
            code = main(words, out, self.ask, self.measure)
        return code, out.getvalue(), errors.getvalue()

    def test_exit_code(self) -> None:
        """Without findings the exit code is 0. With a finding it is 1, and the reason and the remedy are printed."""
        code, printed, _ = self.run_it(str(self.settings))
        self.assertEqual((code, printed), (0, "no problem found; run it again while the node runs\n"))
        self.assertEqual(self.measured, [("dog1", False, None)])
        self.facts = replace(WELL, open_files=(("dog1.toml", 0o644),))
        code, printed, _ = self.run_it(str(self.settings))
        self.assertEqual(code, 1)
        for part in ("ERROR  key-readable: ", "    why: Its mode is 0644.", "    do:  Run chmod 600 dog1.toml"):
            self.assertIn(part, printed)

    def test_running_node_is_asked(self) -> None:
        """The running node of the settings is queried over its control socket, and each of its links gets a score."""
        self.runs("dog1")
        code, printed, _ = self.run_it(str(self.settings))
        self.assertEqual((code, self.measured[0][1]), (0, True))
        self.assertIn("cdcdcdcdcd  192.168.1.9:8484  100/100  2.0 ms, jitter 0.0 ms, 0 % lost\n", printed)
        self.assertIn("~ef:1    0/100  does not reply\n", printed)

    def test_running_node_without_settings(self) -> None:
        """Without settings the only running node is queried, and the refusals that it recorded are findings."""
        self.runs("dog1")
        self.health = {**HEALTH, "address": "127.0.0.1:8484", "refusals": [["revoked", "192.168.1.9:8484"]]}
        code, printed, _ = self.run_it()
        self.assertEqual((code, self.measured), (1, []))
        self.assertIn("certificate-revoked", printed)

    def test_json(self) -> None:
        """With --json findings and links are printed as one line of JSON."""
        self.runs("dog1")
        self.facts = replace(WELL, open_files=(("dog1.toml", 0o644),))
        code, printed, _ = self.run_it("--json", str(self.settings))
        read = json.loads(printed)
        self.assertEqual((code, printed.count("\n")), (1, 1))
        self.assertEqual((read["findings"][0]["cause"], read["findings"][0]["weight"]), ("key-readable", "error"))
        self.assertEqual([each["score"] for each in read["links"]], [100, 0])

    def test_refusals(self) -> None:
        """Missing settings without a running node, and invalid settings, give one error line and exit code 2."""
        code, _, complaint = self.run_it()
        self.assertEqual(code, 2)
        self.assertIn("swarm doctor SETTINGS", complaint)
        self.settings.write_text("[node]\nport = 1\n", encoding="utf-8")
        code, _, complaint = self.run_it(str(self.settings))
        self.assertEqual((code, complaint.count("\n")), (2, 1))
        self.assertIn("[node] name: is missing", complaint)
