"""Tests of the SQLite store and of its writer thread."""

from __future__ import annotations

import os
import sqlite3
import stat
import subprocess
import sys
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

from twisted.internet.defer import CancelledError
from twisted.logger import ILogObserver, LogEvent, globalLogPublisher
from twisted.trial.unittest import SynchronousTestCase
from zope.interface import implementer

from middleware.entangled.data import writer_thread
from middleware.entangled.data.schema import MAX_CORRUPT_ROWS, SCHEMA_VERSION
from middleware.entangled.data.sqlite import SqliteStore, read_records
from middleware.entangled.data.store import MAX_BYTES, Durability, Store, count_bytes
from middleware.entangled.errors import BadStore, NotRunning, Unwritable
from middleware.entangled.record import MAX_VALUE_BYTES, Record, hash_key
from tests.middleware.test_store import CAT, DOG, FOREVER, KEY, StoreContract, record


class SqliteStoreTest(StoreContract, SynchronousTestCase):
    def make(self, max_rows: int, max_bytes: int = MAX_BYTES, hold: float = 30.0) -> SqliteStore:
        store = SqliteStore.open(self.mktemp(), 0.0, max_rows, max_bytes, hold)
        self.addCleanup(store.close)
        return store

    def settle(self, store: Store) -> None:
        assert isinstance(store, SqliteStore)
        store.flush()

    def test_after_close(self) -> None:
        """A closed store rejects puts and notes."""
        self.store.close()
        self.assertRaises(NotRunning, self.store.put, record(), FOREVER)
        self.assertRaises(NotRunning, self.store.set_note, "seed", b"")
        self.failureResultOf(self.store.wait_for_write(), NotRunning)


class ReopenTest(SynchronousTestCase):
    def setUp(self) -> None:
        self.path = self.mktemp()
        self.store = self.reopened(0.0)

    def reopened(self, now: float) -> SqliteStore:
        store = SqliteStore.open(self.path, now)
        self.addCleanup(store.close)
        return store

    def after_restart(self, now: float = 0.0) -> SqliteStore:
        self.store.close()
        return self.reopened(now)

    def after_a_kill(self, durable: Durability, late: str = "") -> SqliteStore:
        """Return the store of a process that was killed after it had flushed 300 records and run ``late``."""
        self.store.close()
        child = (
            "import os, sys\n"
            "from middleware.entangled.data.sqlite import SqliteStore\n"
            "from tests.middleware.test_store import record\n"
            f"store = SqliteStore.open(sys.argv[1], 0.0, durable={durable!r})\n"
            "for number in range(300): store.put(record(str(number), value=None), 9e9)\n"
            f"store.flush()\n{late}"
            "os.kill(os.getpid(), 9)\n"
        )
        root = Path(__file__).parents[2]
        ended = subprocess.run([sys.executable, "-c", child, os.path.abspath(self.path)], cwd=root, check=False)
        self.assertEqual(ended.returncode, -9)
        return self.reopened(0.0)

    def test_what_comes_back(self) -> None:
        """A restart keeps notes, team records and tombstones with a full TTL, but no leased records."""
        kept = [record("a"), record("b", sequence=3, value=None), record("c", value=b"")]
        for one in kept:
            self.store.put(one, 1.0)
        self.store.put(record("d", lifetime="leased"), FOREVER)
        self.store.set_note("seed", DOG.seed)
        store = self.after_restart(now=100.0)
        store.flush()
        self.assertEqual(store.get(KEY, tombstones=True), kept)
        self.assertEqual(read_records(self.path, KEY), [kept[0], kept[2]])
        self.assertEqual(store.get_note("seed"), DOG.seed)
        self.assertEqual(store.expire(159.0), [])
        self.assertEqual(store.expire(160.0), kept)

    def test_what_left_stays_away(self) -> None:
        """A record that expired, or was superseded by another record, is absent after a restart.

        A record that was put again is present.
        """
        for name in "ac":
            self.store.put(record(name), 1.0)
        self.store.put(record("b"), FOREVER)
        self.store.put(record("b", sequence=2), FOREVER)
        self.store.expire(1.0)
        self.store.put(record("c"), FOREVER)  # the store is closed before its first write
        self.assertEqual(self.after_restart().get(KEY), [record("b", sequence=2), record("c")])

    def test_many_changes(self) -> None:
        """Changes that are too many for one commit are all written."""
        for number in range(1000):
            self.store.put(record(str(number), value=None), FOREVER)
        self.assertEqual(len(self.after_restart()), 1000)

    def test_rotten_rows(self) -> None:
        """A corrupted row is counted, moved to a separate table and not returned; the other rows are loaded."""
        changes = (
            "sequence = 'x'",
            "sequence = sequence + 1",
            "name = CAST(x'ff' AS TEXT)",
            "value = x'00'",
            "value = NULL",
            "ttl = 61.0",
            "signature = x''",
            "lifetime = 'leased'",
            "key = 7",
            "crc = crc + 1",
        )
        for number in range(len(changes) + 1):
            self.store.put(record(f"r{number}"), FOREVER)
        self.store.close()
        with closing(sqlite3.connect(self.path)) as connection, connection:
            for number, change in enumerate(changes):
                connection.execute(f"UPDATE records SET {change} WHERE name = 'r{number}'")
        whole = record(f"r{len(changes)}")
        self.assertEqual(read_records(self.path, KEY), [whole])
        store = self.reopened(0.0)
        self.assertEqual((store.corrupt_rows, store.records()), (len(changes), [whole]))
        self.assertEqual(store.usage.bytes, count_bytes(whole))
        store.put(record("r0"), FOREVER)
        store.close()
        with closing(sqlite3.connect(self.path)) as connection:
            self.assertEqual(connection.execute("SELECT count(*) FROM rotten").fetchone(), (len(changes),))
        store = self.reopened(0.0)
        self.assertEqual((store.corrupt_rows, store.records()), (0, [whole, record("r0")]))

    def test_rotten_rows_do_not_pile_up(self) -> None:
        """The table of corrupted rows is limited, and keeps the newest rows."""
        for number in range(MAX_CORRUPT_ROWS + 5):
            self.store.put(record(str(number)), FOREVER)
        self.store.close()
        with closing(sqlite3.connect(self.path)) as connection, connection:
            connection.execute("UPDATE records SET ttl = 1.0")
        self.reopened(0.0).close()
        with closing(sqlite3.connect(self.path)) as connection:
            self.assertEqual(connection.execute("SELECT count(*) FROM rotten").fetchone(), (MAX_CORRUPT_ROWS,))

    def test_rotten_note(self) -> None:
        """A corrupted note is counted and not returned, even if it contains the node's identity."""
        self.store.set_note("identity", DOG.seed)
        self.store.set_note("contacts", b"some")
        self.store.close()
        with closing(sqlite3.connect(self.path)) as connection, connection:
            connection.execute("UPDATE notes SET value = zeroblob(32) WHERE name = 'identity'")
        store = self.reopened(0.0)
        self.assertEqual(
            (store.get_note("identity"), store.get_note("contacts"), store.corrupt_rows), (None, b"some", 1)
        )

    def test_epoch(self) -> None:
        """The epoch of a file is constant, and differs from the epoch of any other file."""
        epoch = self.store.epoch
        store = self.after_restart()
        self.assertEqual((store.epoch, store.origin), (epoch, "kept"))
        with closing(SqliteStore.open(self.mktemp(), 0.0)) as other:
            self.assertNotEqual(other.epoch, epoch)
        with closing(SqliteStore.open(self.mktemp(), 0.0, fresh_epoch=b"12345678")) as told:
            self.assertEqual(told.epoch, b"12345678")

    def test_large_values(self) -> None:
        """Values of the maximum size survive a restart, and are included in the byte count."""
        owners = (DOG, DOG, CAT, CAT)
        kept = [record(str(n), value=bytes([n]) * MAX_VALUE_BYTES, owner=owner) for n, owner in enumerate(owners)]
        for one in kept:
            self.store.put(one, FOREVER)
        store = self.after_restart()
        self.assertEqual(store.records(), kept)
        self.assertEqual(store.usage.bytes, sum(map(count_bytes, kept)))

    def test_killed_in_the_middle(self) -> None:
        """At each durability level, flushed records survive even if the process is killed during later writes."""
        late = "for number in range(300): store.put(record('late' + str(number), value=None), 9e9)\n"
        levels: tuple[Durability, ...] = ("power", "crash")
        for durable in levels:
            with closing(self.after_a_kill(durable, late)) as store:
                self.assertLessEqual({str(number) for number in range(300)}, {r.name for r in store.records()})

    def test_how_durable(self) -> None:
        """The store waits for the disk at each commit, except at the durability level ``crash``."""
        asked: dict[Durability, str] = {"power": "2", "crash": "1"}
        for durable, synchronous in asked.items():
            with closing(SqliteStore.open(self.mktemp(), 0.0, durable=durable)) as store:
                found = store._connection.execute("PRAGMA synchronous").fetchone()
                self.assertEqual(str(found[0]), synchronous)
        self.assertEqual(self.store._connection.execute("PRAGMA synchronous").fetchone(), (2,))

    def test_one_node_a_file(self) -> None:
        """A second node cannot open a file in use; when the first node has closed the file, the second can open it."""
        error = self.assertRaises(BadStore, SqliteStore.open, self.path, 0.0)
        self.assertIn(f"another node uses it (process {os.getpid()})", str(error))
        self.after_restart()

    def test_only_for_its_owner(self) -> None:
        """Only the owner can read the file and its log, because they contain the seed of the identity."""
        self.store.put(record(), FOREVER)
        self.store.flush()
        for path in (self.path, self.path + "-wal", self.path + "-shm"):
            self.assertEqual(stat.S_IMODE(os.stat(path).st_mode), 0o600, path)
        self.store.close()
        os.chmod(self.path, 0o644)
        self.reopened(0.0)
        self.assertEqual(stat.S_IMODE(os.stat(self.path).st_mode), 0o600)


class FullDiskTest(SynchronousTestCase):
    def setUp(self) -> None:
        # Only a flush commits, so no commit comes between two changes.
        self.patch(writer_thread, "COMMIT_AFTER_S", 60.0)
        self.store = SqliteStore.open(self.mktemp(), 0.0)
        self.addCleanup(self.store.close)
        self.store.put(record("a"), FOREVER)
        self.store.flush()
        # Without a free page SQLite reports a full disk.
        self.limit(1)
        for number in range(40):
            self.store.put(record(str(number), value=bytes(900)), FOREVER)
        self.fail_to_flush()

    def fail_to_flush(self) -> None:
        """Flush until a commit fails."""
        for _ in range(100):
            self.assertRaises(BadStore, self.store.flush, 0.1)
            if self.store.write_error:
                return
        self.fail("no commit failed")

    def limit(self, pages: int) -> None:
        self.store._connection.execute(f"PRAGMA max_page_count = {pages}").fetchone()

    def test_refuses_by_name(self) -> None:
        """On a full disk a node rejects new records with the reason, but still reads, renews and expires records."""
        error = self.assertRaises(Unwritable, self.store.put, record("b"), FOREVER)
        self.assertIn("full", str(error))
        self.assertFalse(self.store.put(record("a"), FOREVER))
        self.assertIn(record("a"), self.store.get(KEY))
        self.assertEqual(len(self.store.expire(FOREVER)), 41)
        self.limit(10_000)

    def test_who_waits_is_told(self) -> None:
        """The first failed commit fails the pending acknowledgement.

        New acknowledgements fail until a commit succeeds.
        """
        self.failureResultOf(self.store.wait_for_write(), Unwritable)
        self.limit(10_000)
        self.store.flush()
        self.limit(1)
        for number in range(20):
            self.store.put(record(f"x{number}", value=bytes(900)), FOREVER)
        waiting = self.store.wait_for_write()
        self.fail_to_flush()
        self.assertIn("full", str(self.failureResultOf(waiting, Unwritable).value))
        self.assertIn("full", self.store.write_error)
        self.limit(10_000)
        self.store.flush()
        self.assertEqual(self.store.write_error, "")
        self.successResultOf(self.store.wait_for_write())
        self.assertEqual(len(read_records(self.store._path, KEY)), 61)  # with the changes that were pending before

    def test_read_only(self) -> None:
        """A file that becomes read-only rejects records like a full disk, and recovers."""
        self.limit(10_000)
        self.store.flush()
        self.store._connection.execute("PRAGMA query_only = 1")
        self.store.put(record("x"), FOREVER)
        self.fail_to_flush()
        self.assertIn("readonly", str(self.assertRaises(Unwritable, self.store.put, record("y"), FOREVER)))
        self.store._connection.execute("PRAGMA query_only = 0")
        self.store.flush()
        self.assertTrue(self.store.put(record("y"), FOREVER))

    def test_ends_all_the_same(self) -> None:
        """A store with a full disk closes without waiting and logs the number of lost changes."""
        lost: list[object] = []

        @implementer(ILogObserver)
        def seen(event: LogEvent) -> None:
            lost.append(event.get("left"))

        globalLogPublisher.addObserver(seen)
        self.addCleanup(globalLogPublisher.removeObserver, seen)
        self.store.close()
        self.assertIn(40, lost)


class BadFileTest(SynchronousTestCase):
    def refusal(self, path: str) -> str:
        """Return the one-line error for the store at ``path``."""
        line = str(self.assertRaises(BadStore, SqliteStore.open, path, 0.0))
        self.assertNotIn("\n", line)
        self.assertIn(path, line)
        self.assertIn("; ", line)
        return line

    def test_no_store(self) -> None:
        """A directory, a path below a file, and a file of another type are rejected and not changed."""
        folder, path = self.mktemp(), self.mktemp()
        os.mkdir(folder)
        self.assertIn("is a directory", self.refusal(folder))
        self.assertIn("No such file", self.refusal(path + "/store"))
        text = "a letter to a friend\n" * 100
        Path(path).write_text(text)
        os.chmod(path, 0o640)
        self.assertIn("Not a directory", self.refusal(path + "/store"))
        self.assertIn("not a database", self.refusal(path))
        self.assertEqual(Path(path).read_text(), text)
        self.assertEqual(stat.S_IMODE(os.stat(path).st_mode), 0o640)
        os.remove(path)  # the test must not leave a lock on the file
        with closing(SqliteStore.open(path, 0.0)) as store:
            self.assertEqual((store.origin, len(store)), ("new", 0))

    def test_of_another_program(self) -> None:
        """A database of another program is recognized by its application id, version or tables, and rejected."""
        for statement in ("PRAGMA application_id = 7", "PRAGMA user_version = 1", "CREATE TABLE letters(text)"):
            path = self.mktemp()
            with closing(sqlite3.connect(path)) as connection:
                connection.execute(statement)
            self.assertIn("another program", self.refusal(path))

    def test_newer_schema(self) -> None:
        """A store of a newer schema version is rejected."""
        path = self.mktemp()
        SqliteStore.open(path, 0.0).close()
        with closing(sqlite3.connect(path)) as connection:
            connection.execute(f"PRAGMA user_version = {SCHEMA_VERSION + 1}")
        self.assertIn(f"schema {SCHEMA_VERSION + 1}", self.refusal(path))


class ReadRecordsTest(SynchronousTestCase):
    def test_beside_a_running_node(self) -> None:
        """``read_records`` returns the valid records of a key in order, even if a node has the file open."""
        path = Path(self.mktemp() + " what?#")
        store = SqliteStore.open(path, 0.0)
        self.addCleanup(store.close)
        live = [record("a"), record("b", lifetime="leased"), record("a", owner=CAT)]
        others: list[Record] = [record("c", value=None), record("a", key=hash_key("tasks"))]
        for one in live + others:
            store.put(one, FOREVER)
        store.flush()
        self.assertEqual(read_records(path, KEY), sorted(live, key=lambda r: (r.owner, r.name)))

    def test_no_such_file(self) -> None:
        """A missing file raises ``BadStore`` and is not created."""
        path = self.mktemp()
        error = self.assertRaises(BadStore, read_records, path, KEY)
        self.assertIn(path, str(error))
        self.assertFalse(os.path.exists(path))


class SlowDiskTest(SynchronousTestCase):
    def setUp(self) -> None:
        path = self.mktemp()
        self.news: list[Callable[[], None]] = []
        self.store = SqliteStore.open(path, 0.0, deliver=self.news.append)
        self.addCleanup(self.store.close)
        self.store.flush()
        # A process that holds the write lock of the file blocks every commit.
        self.other = sqlite3.connect(path, isolation_level=None)
        self.addCleanup(self.other.close)
        self.other.execute("BEGIN IMMEDIATE")

    def test_nobody_waits_for_a_commit(self) -> None:
        """During a blocked commit reads, puts and expiry work, but nothing is acknowledged before the commit ends."""
        self.store.put(record("a"), FOREVER)
        first = self.store.wait_for_write()
        for number in range(500):
            self.store.put(record(str(number), value=None), 5.0)
        self.store.expire(5.0)
        self.store.set_note("seed", b"seed")
        later = self.store.wait_for_write()
        self.assertEqual(self.store.get(KEY), [record("a")])
        self.assertNoResult(first)
        self.assertNoResult(later)
        self.other.execute("COMMIT")
        self.store.flush()
        self.successResultOf(first)
        self.successResultOf(later)

    def test_news_are_delivered(self) -> None:
        """An acknowledgement fires in the thread of the caller, through ``deliver``."""
        self.store.put(record("a"), FOREVER)
        waiting = self.store.wait_for_write()
        self.other.execute("COMMIT")
        writer = self.store._writer
        with writer._condition:
            self.assertTrue(writer._condition.wait_for(lambda: not writer._pending and not writer._is_writing, 5.0))
        self.assertNoResult(waiting)
        self.store.close()
        self.successResultOf(waiting)
        self.assertNotEqual(self.news, [])
        for tell in self.news:
            tell()

    def test_who_stops_waiting(self) -> None:
        """Cancelling one acknowledgement does not affect others."""
        self.store.put(record("a"), FOREVER)
        one, other = self.store.wait_for_write(), self.store.wait_for_write()
        one.cancel()
        self.failureResultOf(one, CancelledError)
        self.other.execute("COMMIT")
        self.store.flush()
        self.successResultOf(other)
