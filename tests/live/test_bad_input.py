"""Real ``twistd`` processes that are given bad input, and one that waits for a bootstrap that is not up."""

from __future__ import annotations

import os
import signal
import socket
import sqlite3
import subprocess
import sys
import time
from contextlib import closing
from pathlib import Path

from twisted.trial.unittest import SynchronousTestCase

from drivers.registry import kinds

ROOT = Path(__file__).resolve().parents[2]
PATIENCE_S = 30.0


class LiveTests(SynchronousTestCase):
    """Nodes in processes of their own."""

    def setUp(self) -> None:
        super().setUp()
        self.folder = Path(self.mktemp()).resolve()
        self.folder.mkdir()

    def start(self, *arguments: str) -> subprocess.Popen[str]:
        """A node in a process of its own."""
        twistd = str(Path(sys.executable).parent / "twistd")
        command = [sys.executable, twistd, "-n", "--pidfile=", "swarm-node", *arguments]
        environment = {**os.environ, "PYTHONPATH": str(ROOT), "PYTHONUNBUFFERED": "1"}
        return subprocess.Popen(
            command, cwd=self.folder, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )

    def refused(self, *arguments: str) -> str:
        """The line that a node is refused with."""
        child = self.start(*arguments)
        self.addCleanup(child.kill)
        output, errors = child.communicate(timeout=PATIENCE_S)
        self.assertEqual(child.returncode, 2, output + errors)
        self.assertEqual(len(errors.splitlines()), 1, errors)
        self.assertNotIn("Traceback", output + errors)
        return errors.strip()

    def file(self, text: str) -> str:
        """A settings file."""
        path = self.folder / "node.toml"
        path.write_text(text, encoding="utf-8")
        return str(path)

    def assert_says(self, line: str, *parts: str) -> None:
        """The line has each part."""
        for part in ("swarm-node: ", *parts):
            self.assertIn(part, line)


class BadInputTests(LiveTests):
    """One line on stderr, exit code 2, no traceback."""

    def test_unknown_key(self) -> None:
        """An unknown key: file, key, nearest key."""
        path = self.file('[node]\nname = "a"\nteam_key = "t"\nprot = 7000\n')
        self.assert_says(self.refused("--config", path), path, "[node] prot", "the nearest is port")

    def test_wrong_type(self) -> None:
        """A wrong type: file, key, what to write."""
        path = self.file('[node]\nname = "a"\nteam_key = "t"\nport = "many"\n')
        self.assert_says(self.refused("--config", path), path, "[node] port", "write a number")

    def test_missing_name(self) -> None:
        """No name and no file: the flag, and both ways out."""
        self.assert_says(self.refused("--port", "0"), "--name", "--config FILE")

    def test_port_in_use(self) -> None:
        """A UDP port that another program holds: file, key, another port or 0."""
        with closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as taken:
            taken.bind(("127.0.0.1", 0))
            port = taken.getsockname()[1]
            path = self.file(f'[node]\nname = "a"\nteam_key = "t"\nport = {port}\n')
            line = self.refused("--config", path)
        self.assert_says(line, path, "[node] port", str(port), "choose another port, or 0")

    def test_page_port_in_use(self) -> None:
        """A TCP port of the page that another program holds: file, key, another port or 0."""
        with closing(socket.socket()) as taken:
            taken.bind(("127.0.0.1", 0))
            taken.listen()
            port = taken.getsockname()[1]
            path = self.file(f'[node]\nname = "a"\nteam_key = "t"\nroles = ["web"]\n[web]\nport = {port}\n')
            line = self.refused("--config", path)
        self.assert_says(line, path, "[web] port", str(port), "choose another port, or 0")

    def test_address_of_another_machine(self) -> None:
        """An address that this machine has not: file, and an address to be given, not a port."""
        for text, key in (
            ('[node]\nname = "a"\nteam_key = "t"\nhost = "192.0.2.1"\n', "[node]"),
            ('[node]\nname = "a"\nteam_key = "t"\nroles = ["web"]\n[web]\nhost = "192.0.2.1"\nport = 0\n', "[web]"),
        ):
            path = self.file(text)
            line = self.refused("--config", path)
            self.assert_says(line, path, key, "192.0.2.1", "give host an address of this machine")
            self.assertNotIn("choose another", line)

    def test_foreign_store(self) -> None:
        """A SQLite file of another program: file, key, the store's name."""
        with closing(sqlite3.connect(self.folder / "birds.sqlite")) as connection:
            connection.execute("CREATE TABLE birds(name TEXT)")
        path = self.file('[node]\nname = "a"\nteam_key = "t"\nstore = "birds.sqlite"\n')
        self.assert_says(self.refused("--config", path), path, "[node] store", "birds.sqlite", "name another file")

    def test_unknown_agent(self) -> None:
        """An unknown agent: file, key, those there are."""
        path = self.file('[node]\nname = "a"\nteam_key = "t"\n[driver]\nkind = "sim"\n[agent]\nmodule = "serch"\n')
        self.assert_says(self.refused("--config", path), path, "[agent] module", "there are search")

    def test_unknown_driver(self) -> None:
        """An unknown kind of robot: file, key, those there are."""
        path = self.file('[node]\nname = "a"\nteam_key = "t"\n[driver]\nkind = "simm"\n')
        self.assert_says(self.refused("--config", path), path, "[driver]", "known are " + ", ".join(kinds()))

    def test_name_without_address(self) -> None:
        """A known node whose name nobody can resolve: file, key, what to write."""
        path = self.file('[node]\nname = "a"\nteam_key = "t"\nknown_nodes = ["no-such-host.invalid:7000"]\n')
        line = self.refused("--config", path)
        self.assert_says(line, path, "[node] known_nodes", "no-such-host.invalid", "write the address in figures")


class UnreachableBootstrapTests(LiveTests):
    """A bootstrap that is not up is no error."""

    def test_unreachable_bootstrap_is_tried_again(self) -> None:
        """A node whose bootstrap does not answer says so, tries again, and ends cleanly within 2 s of SIGTERM."""
        with closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as silent:
            silent.bind(("127.0.0.1", 0))
            port = silent.getsockname()[1]
            key = self.folder / "team.key"
            key.touch(mode=0o600)
            key.write_text("t\n")
            flags = ("--name", "a", "--team-key-file", str(key), "--known-nodes", f"127.0.0.1:{port}")
            child = self.start(*flags, "--store", "a.sqlite")
            self.addCleanup(child.kill)
            assert child.stdout is not None and child.stderr is not None
            self.addCleanup(child.stdout.close)
            self.addCleanup(child.stderr.close)
            tries = 0
            for line in child.stdout:
                tries += f"no answer from 127.0.0.1:{port}; trying again" in line
                if tries == 2:
                    break
            self.assertEqual(tries, 2, "the node ended")
            child.send_signal(signal.SIGTERM)
            began = time.monotonic()
            output, errors = child.communicate(timeout=PATIENCE_S)
        self.assertLess(time.monotonic() - began, 2.0)
        # After an orderly end Twisted lets the signal have its way, so that a shell sees what ended the program.
        self.assertEqual((child.returncode, errors), (-signal.SIGTERM, ""), output)
        self.assertIn("Server Shut Down", output)
        self.assertNotIn("Traceback", output)
        self.assertNotIn("Unhandled", output)
