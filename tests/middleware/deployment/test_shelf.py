"""Tests of ``middleware.deployment.shelf``: a stored file is complete or absent."""

from __future__ import annotations

from pathlib import Path

from twisted.trial.unittest import SynchronousTestCase

from middleware.deployment.shelf import FileShelf, MemoryShelf, Shelf


class FileShelfTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.folder = Path(self.mktemp()) / "deployed"

    def test_keeps_and_drops(self) -> None:
        """Both implementations list the stored entries in the order of their names, without the dropped ones."""
        shelves: list[Shelf] = [FileShelf(self.folder), MemoryShelf()]
        for shelf in shelves:
            self.assertEqual(shelf.everything(), [])
            shelf.drop("a")
            shelf.keep("b", b"2")
            shelf.keep("a", b"1")
            shelf.keep("b", b"3")
            self.assertEqual(shelf.everything(), [("a", b"1"), ("b", b"3")])
            shelf.drop("a")
            self.assertEqual(shelf.everything(), [("b", b"3")])

    def test_crash_in_the_middle_leaves_the_old(self) -> None:
        """After a crash during a write, the old file is read and the temporary file is removed."""
        FileShelf(self.folder).keep("a", b"old")
        self.assertEqual(self.folder.stat().st_mode & 0o077, 0)

        def crash(source: Path, target: Path) -> None:
            source.write_bytes(b"ne")
            raise OSError("the power failed")

        self.assertRaises(OSError, FileShelf(self.folder, crash).keep, "a", b"new")
        self.assertEqual(len(list(self.folder.iterdir())), 2)
        self.assertEqual(FileShelf(self.folder).everything(), [("a", b"old")])
        self.assertEqual(len(list(self.folder.iterdir())), 1)
