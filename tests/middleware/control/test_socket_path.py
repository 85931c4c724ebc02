"""Tests of ``control.socket_path``, which finds the paths of control sockets."""

from __future__ import annotations

import os
import shutil
import tempfile
from pathlib import Path

from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.control.socket_path import NoControl, find_folder, find_socket, prepare_path


class SocketPathTests(SynchronousTestCase):
    def setUp(self) -> None:
        # The folders of trial are too long for the path of a Unix socket.
        self.runtime = Path(tempfile.mkdtemp())
        self.addCleanup(shutil.rmtree, self.runtime)
        self.patch(os, "environ", {**os.environ, "XDG_RUNTIME_DIR": str(self.runtime)})

    def problem(self, name: str | None) -> str:
        """Return the error message when no socket is found."""
        return str(self.assertRaises(NoControl, find_socket, name))

    def test_only_node_needs_no_name(self) -> None:
        """If only one node runs, its name can be omitted.

        With no node, several nodes or an unknown name, the error states the problem.
        """
        self.assertIn("no node runs", self.problem(None))
        self.assertIn("no node runs", self.problem("a"))
        prepare_path("a").touch()
        self.assertEqual(find_socket(None), find_socket("a"))
        prepare_path("b").touch()
        self.assertIn("--node NAME: a, b", self.problem(None))
        self.assertIn("run: a, b", self.problem("c"))
        self.assertEqual(find_socket("b").name, "b.control")

    def test_folder_is_the_owners_alone(self) -> None:
        """A folder that other users can access, a symbolic link and a file are rejected with an error."""
        prepare_path("a")
        self.assertEqual(find_folder().stat().st_mode & 0o777, 0o700)
        find_folder().chmod(0o777)
        self.assertIn("accessible to other users", str(self.assertRaises(NoControl, prepare_path, "a")))
        find_folder().rmdir()
        find_folder().symlink_to(self.runtime)
        self.assertIn("accessible to other users", str(self.assertRaises(NoControl, prepare_path, "a")))
        find_folder().unlink()
        find_folder().touch()
        self.assertRaises(NoControl, prepare_path, "a")

    def test_path_that_is_too_long(self) -> None:
        """A path that is too long for a socket address is rejected before a socket is opened."""
        deep = self.runtime / ("x" * 100)
        self.patch(os, "environ", {**os.environ, "XDG_RUNTIME_DIR": str(deep)})
        self.assertIn("107", str(self.assertRaises(NoControl, prepare_path, "a")))

    def test_without_runtime_folder(self) -> None:
        """Without ``XDG_RUNTIME_DIR`` the sockets are in a folder for the user in /tmp."""
        self.patch(os, "environ", {})
        self.assertEqual(str(find_folder()), f"/tmp/swarm-node-{os.getuid()}")
