"""Tests of ``control.place``: where control sockets lie."""

from __future__ import annotations

import os
import shutil
import tempfile
from pathlib import Path

from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.control.place import NoControl, folder, found, made


class PlaceTests(SynchronousTestCase):
    def setUp(self) -> None:
        # Trial's own folders are deeper than the path of a socket may be.
        self.runtime = Path(tempfile.mkdtemp())
        self.addCleanup(shutil.rmtree, self.runtime)
        self.patch(os, "environ", {**os.environ, "XDG_RUNTIME_DIR": str(self.runtime)})

    def problem(self, name: str | None) -> str:
        """What is said where no socket is found."""
        return str(self.assertRaises(NoControl, found, name))

    def test_only_node_needs_no_name(self) -> None:
        """Where one node runs it is meant; where none or several do, or another name is asked for, one is told so."""
        self.assertIn("no node runs", self.problem(None))
        self.assertIn("no node runs", self.problem("a"))
        made("a").touch()
        self.assertEqual(found(None), found("a"))
        made("b").touch()
        self.assertIn("--node NAME: a, b", self.problem(None))
        self.assertIn("run: a, b", self.problem("c"))
        self.assertEqual(found("b").name, "b.control")

    def test_folder_is_the_owners_alone(self) -> None:
        """A folder that others can enter, or that is none, is refused with the remedy."""
        made("a")
        self.assertEqual(folder().stat().st_mode & 0o777, 0o700)
        folder().chmod(0o777)
        self.assertIn("accessible to other users", str(self.assertRaises(NoControl, made, "a")))
        folder().rmdir()
        folder().symlink_to(self.runtime)
        self.assertIn("accessible to other users", str(self.assertRaises(NoControl, made, "a")))
        folder().unlink()
        folder().touch()
        self.assertRaises(NoControl, made, "a")

    def test_path_that_is_too_long(self) -> None:
        """A path that does not fit into a socket's address is refused before anything is opened."""
        deep = self.runtime / ("x" * 100)
        self.patch(os, "environ", {**os.environ, "XDG_RUNTIME_DIR": str(deep)})
        self.assertIn("107", str(self.assertRaises(NoControl, made, "a")))

    def test_without_runtime_folder(self) -> None:
        """Without ``XDG_RUNTIME_DIR`` the sockets lie in a folder of the user's own in /tmp."""
        self.patch(os, "environ", {})
        self.assertEqual(str(folder()), f"/tmp/swarm-node-{os.getuid()}")
