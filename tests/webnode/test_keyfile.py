"""Tests of ``webnode.keyfile``: private keys are stored only in files with private modes."""

from __future__ import annotations

import os
import stat
from pathlib import Path

from twisted.trial.unittest import SynchronousTestCase

from webnode.keyfile import UnsafeFile, read_key_file, write_key_file


class KeyfileTests(SynchronousTestCase):
    def setUp(self) -> None:
        folder = Path(self.mktemp())
        folder.mkdir()
        self.path = folder / "node.sqlite.tls"

    def refusal(self) -> str:
        return str(self.assertRaises(UnsafeFile, read_key_file, self.path))

    def test_keep_for_the_user_alone(self) -> None:
        """A stored key replaces an older key, and is private whatever the umask is."""
        self.addCleanup(os.umask, os.umask(0))
        self.assertIsNone(read_key_file(self.path))
        for content in (b"first", b"second"):
            write_key_file(self.path, content)
            self.assertEqual(read_key_file(self.path), content)
            self.assertEqual(stat.S_IMODE(self.path.stat().st_mode), 0o600)
        self.assertEqual([each.name for each in self.path.parent.iterdir()], [self.path.name])

    def test_refuse_what_others_may_read(self) -> None:
        """A file that group or others can read or write is rejected; the error contains the mode."""
        write_key_file(self.path, b"secret")
        for mode in (0o640, 0o604, 0o620, 0o602):
            self.path.chmod(mode)
            self.assertIn(f"mode {mode:o}", self.refusal())

    def test_refuse_what_is_no_file(self) -> None:
        """A link, a folder and a pipe are rejected without blocking."""
        other = self.path.with_name("other")
        write_key_file(other, b"secret")
        self.path.symlink_to(other)
        self.assertIn("cannot be read", self.refusal())
        self.path.unlink()
        os.mkfifo(self.path, 0o600)
        self.assertIn("not a regular file", self.refusal())
        self.path.unlink()
        self.path.mkdir(0o700)
        self.assertIn("not a regular file", self.refusal())
