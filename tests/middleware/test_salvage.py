"""What becomes of a store whose file has rotted."""

from __future__ import annotations

import os
import random
import sqlite3
from contextlib import closing
from pathlib import Path

from twisted.logger import ILogObserver, LogEvent, formatEvent, globalLogPublisher
from twisted.trial.unittest import SynchronousTestCase
from zope.interface import implementer

from middleware.entangled.data.salvage import set_aside
from middleware.entangled.data.sqlite import SqliteStore
from tests.middleware.test_store import DOG, FOREVER, record


class RottenFileTest(SynchronousTestCase):
    def setUp(self) -> None:
        self.path = self.mktemp()
        self.lines: list[str] = []

        @implementer(ILogObserver)
        def seen(event: LogEvent) -> None:
            self.lines.append(formatEvent(event))

        globalLogPublisher.addObserver(seen)
        self.addCleanup(globalLogPublisher.removeObserver, seen)
        store = SqliteStore.open(self.path, 0.0)
        self.epoch = store.epoch
        store.note("identity", DOG.seed)
        for number in range(200):
            store.put(record(str(number), value=bytes(500)), FOREVER)
        store.close()

    def overwrite(self, at: int, what: bytes) -> None:
        with open(self.path, "r+b") as file:
            file.seek(at)
            file.write(what)

    def opened_anew(self, number: int = 1) -> SqliteStore:
        """The store that takes the place of the rotten one, which must be set aside unchanged."""
        rotten = Path(self.path).read_bytes()
        store = SqliteStore.open(self.path, 0.0)
        self.addCleanup(store.close)
        self.assertEqual((len(store), store.origin), (0, "replaced"))
        self.assertNotEqual(store.epoch, self.epoch)
        aside = f"{self.path}.rotten-{number}"
        self.assertEqual(Path(aside).read_bytes(), rotten)
        lines = [line for line in self.lines if "rotten" in line]
        self.assertEqual(len(lines), number)
        self.assertIn(aside, lines[-1])
        self.assertTrue(store.put(record(), FOREVER))
        store.flush()
        return store

    def test_header(self) -> None:
        """A file whose header was overwritten is set aside, and the node starts empty and says so."""
        self.overwrite(0, b"\x5a" * 100)
        self.assertIsNone(self.opened_anew().noted("identity"))
        self.assertIn("nothing in it could be saved", self.lines[-1])

    def test_first_page(self) -> None:
        """A file whose first page is gone is known as ours by what stands in the others."""
        self.overwrite(0, random.Random(1).randbytes(4096))
        self.opened_anew()

    def test_application_id(self) -> None:
        """A file whose header no longer says that it is ours is known by its tables, and its notes are saved."""
        self.overwrite(68, b"\1\2\3\4")
        self.assertEqual(self.opened_anew().noted("identity"), DOG.seed)

    def test_pages(self) -> None:
        """A file of which pages were overwritten is not served with holes; notes that are whole are saved."""
        self.overwrite(4096 * 12, b"\xff" * 4096 * 4)
        self.assertEqual(self.opened_anew().noted("identity"), DOG.seed)
        self.assertIn("its notes were saved (identity", self.lines[-1])

    def test_cut_short(self) -> None:
        """A file of which the end is missing is set aside."""
        os.truncate(self.path, os.path.getsize(self.path) // 2)
        self.opened_anew()

    def test_zeros(self) -> None:
        """A file of which a card left nothing but zeros is set aside."""
        Path(self.path).write_bytes(bytes(40_960))
        self.opened_anew()

    def test_without_tables(self) -> None:
        """A file that says it is ours and has not our tables is set aside."""
        with closing(sqlite3.connect(self.path)) as connection:
            connection.execute("DROP TABLE records")
        self.opened_anew()

    def test_again(self) -> None:
        """A second rotten file does not take the name of the first, and the notes live on."""
        self.overwrite(68, b"\1\2\3\4")
        self.opened_anew().close()
        self.overwrite(68, b"\1\2\3\4")
        store = self.opened_anew(2)
        self.assertEqual(store.noted("identity"), DOG.seed)
        store.close()
        with closing(SqliteStore.open(self.path, 0.0)) as kept:
            self.assertEqual(kept.origin, "kept")

    def test_with_its_log(self) -> None:
        """A file that a killed node left with its log, and that rotted since, leaves nothing in the new one."""
        with closing(SqliteStore.open(self.path, 0.0)) as store:
            store.put(record("late"), FOREVER)
            store.flush()
            parts = {part: Path(self.path + part).read_bytes() for part in ("", "-wal")}
        self.assertGreater(len(parts["-wal"]), 0)
        for part, whole in parts.items():
            Path(self.path + part).write_bytes(whole)
        self.overwrite(4096 * 12, bytes(4096 * 20))
        with closing(SqliteStore.open(self.path, 0.0)) as store:
            self.assertEqual((store.origin, len(store), store.noted("identity")), ("replaced", 0, DOG.seed))
        self.assertTrue(Path(self.path + ".rotten-1").exists())
        with closing(SqliteStore.open(self.path, 0.0)) as store:
            self.assertEqual((store.origin, len(store)), ("kept", 0))

    def test_index(self) -> None:
        """A file of which only the index rotted would still answer, but write wrongly; it is set aside."""
        with closing(sqlite3.connect(self.path)) as connection:
            index = "SELECT rootpage FROM sqlite_schema WHERE type = 'index' AND tbl_name = 'records'"
            (page,) = connection.execute(index).fetchone()
        self.overwrite(4096 * (page - 1) + 4000, bytes(range(96)))
        self.assertEqual(self.opened_anew().noted("identity"), DOG.seed)

    def test_parts(self) -> None:
        """What belongs to a file is set aside with it, under a name that nothing bears yet."""
        path = self.mktemp()
        for part in ("", "-wal", "-shm"):
            Path(path + part).write_text(part)
        Path(path + ".rotten-1").touch()
        self.assertEqual(set_aside(path), path + ".rotten-2")
        for part in ("", "-wal", "-shm"):
            self.assertEqual(Path(path + ".rotten-2" + part).read_text(), part)
            self.assertFalse(Path(path + part).exists())

    def test_anywhere(self) -> None:
        """Whichever part of a file is overwritten, it opens with nothing that was not put, or is set aside."""
        whole = Path(self.path).read_bytes()
        rng = random.Random(5)
        put = {record(str(number)).slot for number in range(200)}
        seen = set()
        for _ in range(60):
            for part in ("", "-wal", "-shm"):
                Path(self.path + part).unlink(missing_ok=True)
            Path(self.path).write_bytes(whole)
            self.overwrite(rng.randrange(len(whole)), rng.randbytes(rng.choice((1, 16, 512))))
            with closing(SqliteStore.open(self.path, 0.0)) as store:
                self.assertLessEqual({r.slot for r in store.records()}, put)
                self.assertEqual([r for r in store.records() if r.value != bytes(500)], [])
                self.assertIn(store.noted("identity"), (DOG.seed, None))
                seen.add(f"{store.origin}, {store.rotten > 0}")
                # What is lost without a word would be answered as if it had never been.
                lost = 200 - len(store)
                self.assertTrue(not lost or store.origin == "replaced" or store.rotten >= lost, (lost, store.rotten))
        self.assertEqual(seen, {"kept, False", "kept, True", "replaced, False"})
