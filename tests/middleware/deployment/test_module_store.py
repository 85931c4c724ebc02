"""Tests of ``middleware.deployment.module_store``, in which a file is complete or absent."""

from __future__ import annotations

from pathlib import Path

from twisted.trial.unittest import SynchronousTestCase

from middleware.deployment.module_store import FileModuleStore, MemoryModuleStore, ModuleStore


class FileModuleStoreTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.folder = Path(self.mktemp()) / "deployed"

    def test_keeps_and_drops(self) -> None:
        """Both implementations of the store list the entries in the order of their names, without dropped entries."""
        stores: list[ModuleStore] = [FileModuleStore(self.folder), MemoryModuleStore()]
        for store in stores:
            self.assertEqual(store.list_modules(), [])
            store.delete("a")
            store.save("b", b"2")
            store.save("a", b"1")
            store.save("b", b"3")
            self.assertEqual(store.list_modules(), [("a", b"1"), ("b", b"3")])
            store.delete("a")
            self.assertEqual(store.list_modules(), [("b", b"3")])

    def test_crash_in_the_middle_leaves_the_old(self) -> None:
        """After a crash during a write the old file can be read, and the temporary file is removed."""
        FileModuleStore(self.folder).save("a", b"old")
        self.assertEqual(self.folder.stat().st_mode & 0o077, 0)

        def crash(source: Path, target: Path) -> None:
            source.write_bytes(b"ne")
            raise OSError("the power failed")

        self.assertRaises(OSError, FileModuleStore(self.folder, crash).save, "a", b"new")
        self.assertEqual(len(list(self.folder.iterdir())), 2)
        self.assertEqual(FileModuleStore(self.folder).list_modules(), [("a", b"old")])
        self.assertEqual(len(list(self.folder.iterdir())), 1)
