"""Tests of ``swarm service``: the unit, its installation and the calls of ``systemctl``."""

from __future__ import annotations

import contextlib
import io
import os
import shutil
import stat
import subprocess
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from twisted.trial.unittest import SkipTest, SynchronousTestCase

from middleware.config.settings import Settings
from swarmnode.systemd.command import main
from swarmnode.systemd.unit import Unit, make_unit

PROGRAM = "/opt/swarm-node/bin/twistd"


def unit(node: dict[str, object] | None = None, **tables: dict[str, object]) -> Unit:
    """Return the unit of a system service."""
    mapping = {"node": {"name": "dog1", **(node or {})}, **tables}
    return make_unit(Settings.from_mapping(mapping, "/etc/team/dog1.toml"), PROGRAM, is_user=False)


class UnitTests(SynchronousTestCase):
    """The text of a unit."""

    def test_a_node_may_little(self) -> None:
        """A system unit runs as a dynamic user without capabilities and devices, and can write only its own folders."""
        lines = unit().text.splitlines()
        for line in (
            "DynamicUser=yes",
            "ProtectSystem=strict",
            "NoNewPrivileges=yes",
            "CapabilityBoundingSet=",
            "PrivateDevices=yes",
            "ProtectHome=yes",
            "StateDirectory=swarm-node-dog1",
            "MemoryMax=256M",
            "SystemCallFilter=@system-service",
            "RestartPreventExitStatus=2",
            f"ExecStart={PROGRAM} --nodaemon --pidfile= swarm-node --config %S/swarm-node-dog1/node.toml",
        ):
            self.assertIn(line, lines)

    def test_what_the_settings_need_is_let_through(self) -> None:
        """The unit grants access to a serial device, low ports and home folders only if the node needs them."""
        robot = unit(driver={"kind": "create2", "options": {"port": "/dev/ttyUSB0"}})
        low = unit({"roles": ["web"]}, web={"tls": "auto", "tls_port": 443})
        homes = [
            replace(unit(), twistd="/home/ann/env/bin/twistd"),
            replace(unit(), interpreter="/root/.local/share/uv/python3"),
        ]
        for made, line, other in (
            (robot, "DeviceAllow=/dev/ttyUSB0 rw", "PrivateDevices=yes"),
            (robot, "DevicePolicy=closed", "PrivateDevices=yes"),
            (low, "AmbientCapabilities=CAP_NET_BIND_SERVICE", "AmbientCapabilities="),
            *((each, "ProtectHome=read-only", "ProtectHome=yes") for each in homes),
        ):
            lines = made.text.splitlines()
            self.assertEqual((line in lines, other in lines), (True, False), line)

    def test_names_cannot_add_lines(self) -> None:
        """Spaces, quotes and percent signs of a path are escaped."""
        made = make_unit(Settings.from_mapping({"node": {"name": "a"}}, '/a b/50%"/a.toml'), PROGRAM, is_user=True)
        self.assertIn('--config "/a b/50%%\\"/a.toml"\n', made.text)

    def test_systemd_takes_it(self) -> None:
        """The unit passes the checks of systemd, which rate its exposure below 2 of 10."""
        if shutil.which("systemd-analyze") is None:
            raise SkipTest("systemd-analyze is not installed")
        folder = Path(self.mktemp())
        folder.mkdir()
        file = folder / "swarm-node-dog1.service"
        made = make_unit(
            Settings.from_mapping({"node": {"name": "dog1"}}, "/a.toml"), shutil.which("true") or "", False
        )
        file.write_text(made.text, encoding="utf-8")
        verified = subprocess.run(["systemd-analyze", "verify", file], capture_output=True, text=True, check=False)
        self.assertEqual((verified.returncode, verified.stderr), (0, ""))
        words = ["systemd-analyze", "security", "--offline=true", "--threshold=20", "--no-pager", str(file)]
        judged = subprocess.run(words, capture_output=True, text=True, check=False)
        self.assertEqual(judged.returncode, 0, judged.stdout[-300:])


class CommandTests(SynchronousTestCase):
    """Tests of the verbs with a temporary folder as root."""

    def setUp(self) -> None:
        self.root = Path(self.mktemp()).absolute()
        self.root.mkdir()
        self.told: list[str] = []
        self.codes: dict[str, int] = {}
        self.settings = self.root / "team" / "dog1.toml"
        self.settings.parent.mkdir()
        self.settings.write_text('[node]\nname = "dog1"\nstore = "dog1.sqlite"\nteam_key = "k"\n', encoding="utf-8")
        self.unit = self.root / "etc/systemd/system/swarm-node-dog1.service"
        self.state = self.root / "var/lib/swarm-node-dog1"
        (self.root / "twistd").touch()
        self.program = str(self.root / "python")
        self.closed = Path("/nowhere")

    def can_enter(self, folder: Path) -> bool:
        """Return whether the service's user can enter the folder."""
        return folder != self.closed

    def run_it(self, *words: str, uid: int = 0) -> tuple[int, str, str]:
        """Run the command; return exit code, standard output and standard error."""

        def systemctl(words: Sequence[str]) -> int:
            self.told.append(" ".join(words))
            return self.codes.get(words[1], 0)

        out, errors = io.StringIO(), io.StringIO()
        with contextlib.redirect_stderr(errors):
            code = main(words, out, self.root, uid, systemctl, self.program, self.can_enter)
        return code, out.getvalue(), errors.getvalue()

    def install(self) -> tuple[int, str, str]:
        """Run ``install`` with root rights."""
        return self.run_it("install", str(self.settings))

    def test_install(self) -> None:
        """``install`` writes the unit, copies settings and store with private modes, and starts the service."""
        (self.settings.parent / "dog1.sqlite").write_bytes(b"kept")
        code, printed, _ = self.install()
        self.assertEqual((code, printed), (0, f"{self.unit}\n"))
        self.assertIn("DynamicUser=yes", self.unit.read_text(encoding="utf-8"))
        copied = self.state / "node.toml"
        self.assertEqual(copied.read_bytes(), self.settings.read_bytes())
        self.assertEqual(stat.S_IMODE(copied.stat().st_mode), 0o600)
        self.assertEqual((self.state / "dog1.sqlite").read_bytes(), b"kept")
        self.assertEqual(
            self.told,
            ["systemctl daemon-reload", "systemctl enable swarm-node-dog1", "systemctl restart swarm-node-dog1"],
        )

    def test_install_again_keeps_the_store(self) -> None:
        """A second installation replaces the settings, but not the store of the service."""
        self.install()
        (self.state / "dog1.sqlite").write_bytes(b"newer")
        (self.settings.parent / "dog1.sqlite").write_bytes(b"older")
        self.settings.write_text('[node]\nname = "dog1"\nstore = "dog1.sqlite"\nkind = "x"\n', encoding="utf-8")
        self.assertEqual(self.install()[0], 0)
        self.assertEqual((self.state / "dog1.sqlite").read_bytes(), b"newer")
        self.assertIn("kind", (self.state / "node.toml").read_text(encoding="utf-8"))

    def test_refused_settings(self) -> None:
        """A store outside the settings' folder, and invalid settings, are rejected; the error contains the reason."""
        for text, words in (
            ('[node]\nname = "dog1"\nstore = "/srv/dog1.sqlite"\n', "/srv/dog1.sqlite is outside"),
            ("[node]\n", "[node] name: is missing"),
        ):
            self.settings.write_text(text, encoding="utf-8")
            code, _, complaint = self.install()
            self.assertEqual(code, 2)
            self.assertIn(words, complaint)
            self.assertFalse(self.unit.exists())

    def test_a_program_that_the_service_could_not_run_is_refused(self) -> None:
        """A program in a folder that other users cannot enter is rejected with a remedy."""
        self.closed = self.root
        code, _, complaint = self.install()
        self.assertEqual(code, 2)
        self.assertIn(f"other users cannot enter {self.root}", complaint)
        self.assertIn("/opt", complaint)
        self.assertEqual(self.run_it("show", str(self.settings), "--user")[0], 0)

    def test_the_python_behind_the_environment_counts(self) -> None:
        """If the Python of the virtual environment is a link into a home folder, the unit can read home folders."""
        Path(self.program).symlink_to("/home/ann/.pyenv/bin/python3")
        code, printed, _ = self.run_it("show", str(self.settings))
        self.assertEqual(code, 0)
        self.assertIn("ProtectHome=read-only\n", printed)

    def test_remove(self) -> None:
        """``remove`` stops the service, deletes the unit and keeps the data."""
        self.install()
        self.told.clear()
        self.assertEqual(self.run_it("remove", "dog1")[0], 0)
        self.assertEqual(self.told, ["systemctl disable --now swarm-node-dog1", "systemctl daemon-reload"])
        self.assertFalse(self.unit.exists())
        self.assertTrue((self.state / "node.toml").exists())

    def test_refusals_of_restart_and_systemd(self) -> None:
        """An unknown service is rejected without calling ``systemctl``; if ``systemctl`` fails, the exit code is 1.

        The error contains a hint.
        """
        for verb in ("restart", "remove"):
            code, _, complaint = self.run_it(verb, "cat")
            self.assertEqual((code, self.told), (2, []))
            self.assertIn("swarm-node-cat.service does not exist", complaint)
        self.codes["restart"] = 1
        code, _, complaint = self.install()
        self.assertEqual(code, 1)
        self.assertIn("journalctl -u swarm-node-dog1", complaint)

    def test_without_root_it_is_the_users_own(self) -> None:
        """Without root rights the unit is a unit of the user's systemd, and the settings file is not copied."""
        self.patch(os, "environ", {**os.environ, "XDG_CONFIG_HOME": "/home/ann/.config"})
        code, printed, _ = self.run_it("install", str(self.settings), uid=1000)
        self.assertEqual(code, 0)
        made = self.root / "home/ann/.config/systemd/user/swarm-node-dog1.service"
        self.assertIn(str(made), printed)
        text = made.read_text(encoding="utf-8")
        self.assertIn(f"--config {self.settings}", text)
        self.assertNotIn("DynamicUser", text)
        self.assertEqual(self.told[0], "systemctl --user daemon-reload")
        self.assertFalse(self.state.exists())
