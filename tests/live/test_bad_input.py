"""Tests of real ``twistd`` processes with invalid input, and of a node whose bootstrap node is missing."""

from __future__ import annotations

import signal
import socket
import time
from contextlib import closing

from tests.live.node import PATIENCE_S, NodeCase


class BadInputTests(NodeCase):
    """Invalid input gives one line on stderr and exit code 2; ``tests.swarmnode.test_plugin`` checks each line."""

    def refused(self, *arguments: str) -> str:
        """Return the error line of a node that is refused."""
        child = self.popen(*arguments)
        self.addCleanup(child.kill)
        output, errors = child.communicate(timeout=PATIENCE_S)
        self.assertEqual(child.returncode, 2, output + errors)
        self.assertEqual(len(errors.splitlines()), 1, errors)
        self.assertNotIn("Traceback", output + errors)
        return errors.strip()

    def assert_says(self, line: str, *parts: str) -> None:
        """Check that the line contains each part."""
        for part in ("swarm-node: ", *parts):
            self.assertIn(part, line)

    def test_unknown_key(self) -> None:
        """An unknown key is reported before the start; the error contains file, key and the nearest known key."""
        path = self.file('[node]\nname = "a"\nteam_key = "t"\nprot = 7000\n')
        self.assert_says(self.refused("--config", path), path, "[node] prot", "the nearest is port")

    def test_ports_in_use(self) -> None:
        """A UDP port in use, or a TCP port of the page in use, is reported with file, key and a remedy."""
        for kind, key, text in (
            (socket.SOCK_DGRAM, "[node] port", "port = {}\n"),
            (socket.SOCK_STREAM, "[web] port", 'roles = ["web"]\n[web]\nport = {}\n'),
        ):
            with closing(socket.socket(socket.AF_INET, kind)) as taken:
                taken.bind(("127.0.0.1", 0))
                if kind == socket.SOCK_STREAM:
                    taken.listen()
                port = taken.getsockname()[1]
                path = self.file('[node]\nname = "a"\nteam_key = "t"\n' + text.format(port))
                line = self.refused("--config", path)
            self.assert_says(line, path, key, str(port), "choose another port, or 0")

    def test_address_of_another_machine(self) -> None:
        """An address of another machine is reported with the file; the stated remedy is not a different port."""
        for text, key in (
            ('[node]\nname = "a"\nteam_key = "t"\nhost = "192.0.2.1"\n', "[node]"),
            ('[node]\nname = "a"\nteam_key = "t"\nroles = ["web"]\n[web]\nhost = "192.0.2.1"\nport = 0\n', "[web]"),
        ):
            path = self.file(text)
            line = self.refused("--config", path)
            self.assert_says(line, path, key, "192.0.2.1", "set host to an address of this machine")
            self.assertNotIn("choose another", line)


class UnreachableBootstrapTests(NodeCase):
    """A missing bootstrap node is not an error."""

    def test_unreachable_bootstrap_is_tried_again(self) -> None:
        """A node whose bootstrap node does not reply logs this and retries; it ends within 2 s after SIGTERM."""
        with closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as silent:
            silent.bind(("127.0.0.1", 0))
            port = silent.getsockname()[1]
            flags = ("--name", "a", "--team-key-file", self.key_file(), "--known-nodes", f"127.0.0.1:{port}")
            child = self.popen(*flags, "--store", "a.sqlite")
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
        # After an orderly end Twisted raises the signal again, so a shell can see why the process ended.
        self.assertEqual((child.returncode, errors), (-signal.SIGTERM, ""), output)
        self.assertIn("Server Shut Down", output)
        self.assertNotIn("Traceback", output)
        self.assertNotIn("Unhandled", output)
