"""Tests of ``middleware.deployment.shelf``: a file is whole or not there."""

from __future__ import annotations

from pathlib import Path

from twisted.trial.unittest import SynchronousTestCase

from middleware.deployment.shelf import FileShelf, MemoryShelf, Shelf


class FileShelfTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.folder = Path(self.mktemp()) / "deployed"

    def test_keeps_and_drops(self) -> None:
        """Both shelves do the same: what is kept is there in the order of names, what is dropped is not."""
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
        """A node that ends before a file is in its place has the old one, and no remains, in its next life."""
        FileShelf(self.folder).keep("a", b"old")
        self.assertEqual(self.folder.stat().st_mode & 0o077, 0)

        def crash(source: Path, target: Path) -> None:
            source.write_bytes(b"ne")
            raise OSError("the power failed")

        self.assertRaises(OSError, FileShelf(self.folder, crash).keep, "a", b"new")
        self.assertEqual(len(list(self.folder.iterdir())), 2)
        self.assertEqual(FileShelf(self.folder).everything(), [("a", b"old")])
        self.assertEqual(len(list(self.folder.iterdir())), 1)
