"""Tests of corrupted store files and of files of an older schema."""

from __future__ import annotations

import os
import random
import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

from twisted.logger import ILogObserver, LogEvent, formatEvent, globalLogPublisher
from twisted.trial.unittest import SynchronousTestCase
from zope.interface import implementer

from middleware.entangled.data.recovery import set_aside
from middleware.entangled.data.schema import APPLICATION_ID, SCHEMA_VERSION, create_tables
from middleware.entangled.data.sqlite import SqliteStore
from tests.middleware.test_store import DOG, FOREVER, KEY, record


class CorruptFileTest(SynchronousTestCase):
    def setUp(self) -> None:
        self.lines: list[str] = []

        @implementer(ILogObserver)
        def seen(event: LogEvent) -> None:
            self.lines.append(formatEvent(event))

        globalLogPublisher.addObserver(seen)
        self.addCleanup(globalLogPublisher.removeObserver, seen)
        self.fill()

    def fill(self) -> None:
        """Create a file with 200 records and a note."""
        self.path = self.mktemp()
        store = SqliteStore.open(self.path, 0.0)
        self.epoch = store.epoch
        store.set_note("identity", DOG.seed)
        for number in range(200):
            store.put(record(str(number), value=bytes(500)), FOREVER)
        store.close()

    def overwrite(self, at: int, what: bytes) -> None:
        with open(self.path, "r+b") as file:
            file.seek(at)
            file.write(what)

    def opened_anew(self, number: int = 1) -> SqliteStore:
        """Open the new store that replaces the corrupted file.

        The corrupted file must be kept unchanged under a different name.
        """
        corrupt = Path(self.path).read_bytes()
        store = SqliteStore.open(self.path, 0.0)
        self.addCleanup(store.close)
        self.assertEqual((len(store), store.origin), (0, "replaced"))
        self.assertNotEqual(store.epoch, self.epoch)
        aside = f"{self.path}.rotten-{number}"
        self.assertEqual(Path(aside).read_bytes(), corrupt)
        lines = [line for line in self.lines if "rotten" in line]
        self.assertEqual(len(lines), number)
        self.assertIn(aside, lines[-1])
        self.assertTrue(store.put(record(), FOREVER))
        store.flush()
        return store

    def drop_table(self) -> None:
        with closing(sqlite3.connect(self.path)) as connection:
            connection.execute("DROP TABLE records")

    def rot_index(self) -> None:
        with closing(sqlite3.connect(self.path)) as connection:
            index = "SELECT rootpage FROM sqlite_schema WHERE type = 'index' AND tbl_name = 'records'"
            (page,) = connection.execute(index).fetchone()
        self.overwrite(4096 * (page - 1) + 4000, bytes(range(96)))

    def test_damage(self) -> None:
        """A damaged file is set aside and replaced by an empty one; its readable notes are copied."""
        saved, lost = "its notes were saved (identity", "nothing in it could be saved"
        damages: tuple[tuple[Callable[[], object], str], ...] = (
            (lambda: self.overwrite(0, b"\x5a" * 100), lost),  # the header
            (lambda: self.overwrite(0, random.Random(1).randbytes(4096)), ""),  # the first page
            (lambda: self.overwrite(68, b"\1\2\3\4"), saved),  # the application id of another program
            (lambda: self.overwrite(4096 * 12, b"\xff" * 4096 * 4), saved),
            (lambda: os.truncate(self.path, os.path.getsize(self.path) // 2), ""),
            (lambda: Path(self.path).write_bytes(bytes(40_960)), lost),  # as an SD card does after a power failure
            (self.drop_table, ""),
            (self.rot_index, saved),  # reads would still succeed, but writes would damage the file
        )
        for damage, said in damages:
            self.fill()
            self.lines.clear()
            damage()
            store = self.opened_anew()
            self.assertIn(said, self.lines[-1])
            if said:
                self.assertEqual(store.get_note("identity"), DOG.seed if said == saved else None)

    def test_again(self) -> None:
        """A second corrupted file gets a different name from the first corrupted file, and the notes are kept."""
        self.overwrite(68, b"\1\2\3\4")
        self.opened_anew().close()
        self.overwrite(68, b"\1\2\3\4")
        store = self.opened_anew(2)
        self.assertEqual(store.get_note("identity"), DOG.seed)
        store.close()
        with closing(SqliteStore.open(self.path, 0.0)) as kept:
            self.assertEqual(kept.origin, "kept")

    def test_with_its_log(self) -> None:
        """A corrupted file and its write-ahead log, left by a killed node, do not affect the new file."""
        with closing(SqliteStore.open(self.path, 0.0)) as store:
            store.put(record("late"), FOREVER)
            store.flush()
            parts = {part: Path(self.path + part).read_bytes() for part in ("", "-wal")}
        self.assertGreater(len(parts["-wal"]), 0)
        for part, whole in parts.items():
            Path(self.path + part).write_bytes(whole)
        self.overwrite(4096 * 12, bytes(4096 * 20))
        with closing(SqliteStore.open(self.path, 0.0)) as store:
            self.assertEqual((store.origin, len(store), store.get_note("identity")), ("replaced", 0, DOG.seed))
        self.assertTrue(Path(self.path + ".rotten-1").exists())
        with closing(SqliteStore.open(self.path, 0.0)) as store:
            self.assertEqual((store.origin, len(store)), ("kept", 0))

    def test_parts(self) -> None:
        """A file is set aside together with its -wal and -shm files under an unused name."""
        path = self.mktemp()
        for part in ("", "-wal", "-shm"):
            Path(path + part).write_text(part)
        Path(path + ".rotten-1").touch()
        self.assertEqual(set_aside(path), path + ".rotten-2")
        for part in ("", "-wal", "-shm"):
            self.assertEqual(Path(path + ".rotten-2" + part).read_text(), part)
            self.assertFalse(Path(path + part).exists())

    def test_anywhere(self) -> None:
        """A file that is overwritten at any position is opened without false records, or is set aside."""
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
                self.assertIn(store.get_note("identity"), (DOG.seed, None))
                seen.add(f"{store.origin}, {store.corrupt_rows > 0}")
                # A record that is lost without a report would look as if it had never been written.
                lost = 200 - len(store)
                self.assertTrue(
                    not lost or store.origin == "replaced" or store.corrupt_rows >= lost, (lost, store.corrupt_rows)
                )
        self.assertEqual(seen, {"kept, False", "kept, True", "replaced, False"})


OLD = """
CREATE TABLE records(key BLOB, owner BLOB, name TEXT, sequence INTEGER, lifetime TEXT, ttl REAL, value BLOB,\
 signature BLOB, PRIMARY KEY(key, owner, name)) WITHOUT ROWID;
CREATE TABLE notes(name TEXT PRIMARY KEY, value BLOB);
PRAGMA user_version = 1;
PRAGMA journal_mode = WAL;
"""


class OldSchemaTest(SynchronousTestCase):
    def setUp(self) -> None:
        self.path = self.mktemp()
        self.kept = [record("a"), record("b", sequence=3, value=None), record("c", value=b"")]
        rows: list[tuple[object, ...]] = [
            (r.key, r.owner, r.name, r.sequence, r.lifetime, r.ttl, r.value, r.signature) for r in self.kept
        ]
        rows.append((b"no", b"record", "", 1, "", 1.0, b"", b""))
        with closing(sqlite3.connect(self.path, isolation_level=None)) as connection:
            connection.executescript(OLD + f"PRAGMA application_id = {APPLICATION_ID};")
            connection.executemany("INSERT INTO records VALUES (?, ?, ?, ?, ?, ?, ?, ?)", rows)
            connection.execute("INSERT INTO notes VALUES ('identity', ?)", (DOG.seed,))

    def test_migrates(self) -> None:
        """A file of the previous schema is migrated once, and its invalid rows are kept in another table."""
        for _ in range(2):
            with closing(SqliteStore.open(self.path, 0.0)) as store:
                self.assertEqual(store.get(KEY, tombstones=True), self.kept)
                self.assertEqual((store.get_note("identity"), store.origin, store.corrupt_rows), (DOG.seed, "kept", 0))
                self.assertNotEqual(store.epoch, bytes(8))
                store.put(record("a"), FOREVER)
        with closing(sqlite3.connect(self.path)) as connection:
            self.assertEqual(connection.execute("PRAGMA user_version").fetchone(), (SCHEMA_VERSION,))
            self.assertEqual(connection.execute("SELECT count(*) FROM rotten").fetchone(), (1,))
            names = connection.execute("SELECT name FROM sqlite_schema WHERE type = 'table' ORDER BY name").fetchall()
        self.assertEqual(names, [("notes",), ("records",), ("rotten",)])

    def test_all_or_nothing(self) -> None:
        """A migration that runs out of disk space leaves the old file unchanged, and can be repeated."""
        with closing(sqlite3.connect(self.path, isolation_level=None)) as connection:
            connection.text_factory = bytes
            connection.execute("PRAGMA max_page_count = 1")
            error = self.assertRaises(sqlite3.OperationalError, create_tables, connection, 1)
            self.assertIn("full", str(error))
            self.assertFalse(connection.in_transaction)
        self.test_migrates()
