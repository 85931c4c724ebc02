"""The data store with a file behind it, and the thread that writes it."""

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

from middleware.entangled.data import writer
from middleware.entangled.data.schema import MAX_ROTTEN, SCHEMA_VERSION
from middleware.entangled.data.sqlite import SqliteStore, read_records
from middleware.entangled.data.store import MAX_BYTES, Durable, Store, weight
from middleware.entangled.errors import BadStore, NotRunning, Unwritable
from middleware.entangled.record import MAX_VALUE, Record, hashed_key
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
        """A closed store takes nothing more."""
        self.store.close()
        self.assertRaises(NotRunning, self.store.put, record(), FOREVER)
        self.assertRaises(NotRunning, self.store.note, "seed", b"")
        self.failureResultOf(self.store.written(), NotRunning)


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

    def after_a_kill(self, durable: Durable, late: str = "") -> SqliteStore:
        """The store that another process left, killed when it had flushed 300 records and done ``late``."""
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
        """After a restart notes, team records and tombstones are back, to live a whole ttl from then; no lease is."""
        kept = [record("a"), record("b", sequence=3, value=None), record("c", value=b"")]
        for one in kept:
            self.store.put(one, 1.0)
        self.store.put(record("d", lifetime="leased"), FOREVER)
        self.store.note("seed", DOG.seed)
        store = self.after_restart(now=100.0)
        store.flush()
        self.assertEqual(store.get(KEY, tombstones=True), kept)
        self.assertEqual(read_records(self.path, KEY), [kept[0], kept[2]])
        self.assertEqual(store.noted("seed"), DOG.seed)
        self.assertEqual(store.expire(159.0), [])
        self.assertEqual(store.expire(160.0), kept)

    def test_what_left_stays_away(self) -> None:
        """What ran out, or lost against a newer record, is not back after a restart; what was put again is."""
        for name in "ac":
            self.store.put(record(name), 1.0)
        self.store.put(record("b"), FOREVER)
        self.store.put(record("b", sequence=2), FOREVER)
        self.store.expire(1.0)
        self.store.put(record("c"), FOREVER)  # before anything was written
        self.assertEqual(self.after_restart().get(KEY), [record("b", sequence=2), record("c")])

    def test_many_changes(self) -> None:
        """More changes than fit in one commit all arrive."""
        for number in range(1000):
            self.store.put(record(str(number), value=None), FOREVER)
        self.assertEqual(len(self.after_restart()), 1000)

    def test_rotten_rows(self) -> None:
        """A row in which anything was changed is counted, set aside and absent; the others are back."""
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
        self.assertEqual((store.rotten, store.records()), (len(changes), [whole]))
        self.assertEqual(store.usage.bytes, weight(whole))
        store.put(record("r0"), FOREVER)
        store.close()
        with closing(sqlite3.connect(self.path)) as connection:
            self.assertEqual(connection.execute("SELECT count(*) FROM rotten").fetchone(), (len(changes),))
        store = self.reopened(0.0)
        self.assertEqual((store.rotten, store.records()), (0, [whole, record("r0")]))

    def test_rotten_rows_do_not_pile_up(self) -> None:
        """Of the rows that are set aside the last few are kept."""
        for number in range(MAX_ROTTEN + 5):
            self.store.put(record(str(number)), FOREVER)
        self.store.close()
        with closing(sqlite3.connect(self.path)) as connection, connection:
            connection.execute("UPDATE records SET ttl = 1.0")
        self.reopened(0.0).close()
        with closing(sqlite3.connect(self.path)) as connection:
            self.assertEqual(connection.execute("SELECT count(*) FROM rotten").fetchone(), (MAX_ROTTEN,))

    def test_rotten_note(self) -> None:
        """A note that rotted is absent, be it the identity, and counted."""
        self.store.note("identity", DOG.seed)
        self.store.note("contacts", b"some")
        self.store.close()
        with closing(sqlite3.connect(self.path)) as connection, connection:
            connection.execute("UPDATE notes SET value = zeroblob(32) WHERE name = 'identity'")
        store = self.reopened(0.0)
        self.assertEqual((store.noted("identity"), store.noted("contacts"), store.rotten), (None, b"some", 1))

    def test_epoch(self) -> None:
        """The epoch lasts as long as the file, and another file has another one."""
        epoch = self.store.epoch
        store = self.after_restart()
        self.assertEqual((store.epoch, store.origin), (epoch, "kept"))
        with closing(SqliteStore.open(self.mktemp(), 0.0)) as other:
            self.assertNotEqual(other.epoch, epoch)
        with closing(SqliteStore.open(self.mktemp(), 0.0, fresh_epoch=b"12345678")) as told:
            self.assertEqual(told.epoch, b"12345678")

    def test_large_values(self) -> None:
        """Values as large as a record carries come back byte by byte, and are counted to the byte."""
        owners = (DOG, DOG, CAT, CAT)
        kept = [record(str(n), value=bytes([n]) * MAX_VALUE, owner=owner) for n, owner in enumerate(owners)]
        for one in kept:
            self.store.put(one, FOREVER)
        store = self.after_restart()
        self.assertEqual(store.records(), kept)
        self.assertEqual(store.usage.bytes, sum(map(weight, kept)))

    def test_killed_in_the_middle(self) -> None:
        """What was flushed is there after the process was killed with more on its way, disk waited for or not."""
        late = "for number in range(300): store.put(record('late' + str(number), value=None), 9e9)\n"
        levels: tuple[Durable, ...] = ("power", "crash")
        for durable in levels:
            with closing(self.after_a_kill(durable, late)) as store:
                self.assertLessEqual({str(number) for number in range(300)}, {r.name for r in store.records()})

    def test_how_durable(self) -> None:
        """The store waits for the disk at each commit unless a crash is all that it is to outlive."""
        asked: dict[Durable, str] = {"power": "2", "crash": "1"}
        for durable, synchronous in asked.items():
            with closing(SqliteStore.open(self.mktemp(), 0.0, durable=durable)) as store:
                found = store._connection.execute("PRAGMA synchronous").fetchone()
                self.assertEqual(str(found[0]), synchronous)
        self.assertEqual(self.store._connection.execute("PRAGMA synchronous").fetchone(), (2,))

    def test_one_node_a_file(self) -> None:
        """A second node is kept off a file that is in use, and let in when the first has gone."""
        error = self.assertRaises(BadStore, SqliteStore.open, self.path, 0.0)
        self.assertIn(f"another node uses it (process {os.getpid()})", str(error))
        self.after_restart()

    def test_only_for_its_owner(self) -> None:
        """Nobody else may read the file or its log, for the seed of the identity lies in it."""
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
        # Only a flush commits, so that no commit fails between two changes.
        self.patch(writer, "COMMIT_AFTER", 60.0)
        self.store = SqliteStore.open(self.mktemp(), 0.0)
        self.addCleanup(self.store.close)
        self.store.put(record("a"), FOREVER)
        self.store.flush()
        # No page more than there are: SQLite then says that the disk is full.
        self.limit(1)
        for number in range(40):
            self.store.put(record(str(number), value=bytes(900)), FOREVER)
        self.fail_to_flush()

    def fail_to_flush(self) -> None:
        """Flush until a commit has failed."""
        for _ in range(100):
            self.assertRaises(BadStore, self.store.flush, 0.1)
            if self.store.trouble:
                return
        self.fail("no commit failed")

    def limit(self, pages: int) -> None:
        self.store._connection.execute(f"PRAGMA max_page_count = {pages}").fetchone()

    def test_refuses_by_name(self) -> None:
        """On a full disk a node refuses new records with the reason, and still answers, extends and lets go."""
        error = self.assertRaises(Unwritable, self.store.put, record("b"), FOREVER)
        self.assertIn("full", str(error))
        self.assertFalse(self.store.put(record("a"), FOREVER))
        self.assertIn(record("a"), self.store.get(KEY))
        self.assertEqual(len(self.store.expire(FOREVER)), 41)
        self.limit(10_000)

    def test_who_waits_is_told(self) -> None:
        """Who waits for an acknowledgement is refused it as soon as a commit fails, and at once while none succeeds."""
        self.failureResultOf(self.store.written(), Unwritable)
        self.limit(10_000)
        self.store.flush()
        self.limit(1)
        for number in range(20):
            self.store.put(record(f"x{number}", value=bytes(900)), FOREVER)
        waiting = self.store.written()
        self.fail_to_flush()
        self.assertIn("full", str(self.failureResultOf(waiting, Unwritable).value))
        self.assertIn("full", self.store.trouble)
        self.limit(10_000)
        self.store.flush()
        self.assertEqual(self.store.trouble, "")
        self.successResultOf(self.store.written())
        self.assertEqual(len(read_records(self.store._path, KEY)), 61)  # what was owed, too

    def test_read_only(self) -> None:
        """A file that comes to be read-only is like a full disk: refused by name, and well again afterwards."""
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
        """A node whose disk stays full ends without waiting for it, and the log says what was lost."""
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
        """The one line by which the store at ``path`` is refused."""
        line = str(self.assertRaises(BadStore, SqliteStore.open, path, 0.0))
        self.assertNotIn("\n", line)
        self.assertIn(path, line)
        self.assertIn("; ", line)
        return line

    def test_no_store(self) -> None:
        """A directory, a file in a folder that is none, and another kind of file are refused; the file is as it was."""
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
        os.remove(path)  # no lock was left behind
        with closing(SqliteStore.open(path, 0.0)) as store:
            self.assertEqual((store.origin, len(store)), ("new", 0))

    def test_of_another_program(self) -> None:
        """A database of another program is refused, be it known by its id, its version or its tables."""
        for statement in ("PRAGMA application_id = 7", "PRAGMA user_version = 1", "CREATE TABLE letters(text)"):
            path = self.mktemp()
            with closing(sqlite3.connect(path)) as connection:
                connection.execute(statement)
            self.assertIn("another program", self.refusal(path))

    def test_newer_schema(self) -> None:
        """A store of a newer version of this program is refused."""
        path = self.mktemp()
        SqliteStore.open(path, 0.0).close()
        with closing(sqlite3.connect(path)) as connection:
            connection.execute(f"PRAGMA user_version = {SCHEMA_VERSION + 1}")
        self.assertIn(f"schema {SCHEMA_VERSION + 1}", self.refusal(path))


class ReadRecordsTest(SynchronousTestCase):
    def test_beside_a_running_node(self) -> None:
        """A page reads the live records of a key in order, while the node holds the file."""
        path = Path(self.mktemp() + " what?#")
        store = SqliteStore.open(path, 0.0)
        self.addCleanup(store.close)
        live = [record("a"), record("b", lifetime="leased"), record("a", owner=CAT)]
        others: list[Record] = [record("c", value=None), record("a", key=hashed_key("tasks"))]
        for one in live + others:
            store.put(one, FOREVER)
        store.flush()
        self.assertEqual(read_records(path, KEY), sorted(live, key=lambda r: (r.owner, r.name)))

    def test_no_such_file(self) -> None:
        """Where there is no store the page learns so in one line, and none is made."""
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
        # Whoever holds the file's write lock stalls every commit.
        self.other = sqlite3.connect(path, isolation_level=None)
        self.addCleanup(self.other.close)
        self.other.execute("BEGIN IMMEDIATE")

    def test_nobody_waits_for_a_commit(self) -> None:
        """While a commit stalls all is answered, taken and let go of, but nothing is acknowledged before its end."""
        self.store.put(record("a"), FOREVER)
        first = self.store.written()
        for number in range(500):
            self.store.put(record(str(number), value=None), 5.0)
        self.store.expire(5.0)
        self.store.note("seed", b"seed")
        later = self.store.written()
        self.assertEqual(self.store.get(KEY), [record("a")])
        self.assertNoResult(first)
        self.assertNoResult(later)
        self.other.execute("COMMIT")
        self.store.flush()
        self.successResultOf(first)
        self.successResultOf(later)

    def test_news_are_delivered(self) -> None:
        """An acknowledgement comes in the caller's thread, by way of ``deliver``."""
        self.store.put(record("a"), FOREVER)
        waiting = self.store.written()
        self.other.execute("COMMIT")
        writer = self.store._writer
        with writer._turn:
            self.assertTrue(writer._turn.wait_for(lambda: not writer._owed and not writer._writing, 5.0))
        self.assertNoResult(waiting)
        self.store.close()
        self.successResultOf(waiting)
        self.assertNotEqual(self.news, [])
        for tell in self.news:
            tell()

    def test_who_stops_waiting(self) -> None:
        """Who no longer waits for an acknowledgement does no harm to others that do."""
        self.store.put(record("a"), FOREVER)
        one, other = self.store.written(), self.store.written()
        one.cancel()
        self.failureResultOf(one, CancelledError)
        self.other.execute("COMMIT")
        self.store.flush()
        self.successResultOf(other)
