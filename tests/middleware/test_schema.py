"""The store's file from one version of its schema to the next."""

from __future__ import annotations

import sqlite3
from contextlib import closing

from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.data.schema import APPLICATION_ID, SCHEMA_VERSION, make
from middleware.entangled.data.sqlite import SqliteStore
from tests.middleware.test_store import DOG, FOREVER, KEY, record

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
        """A file of the schema before this one is taken over whole, once, and its bad rows are set aside."""
        for _ in range(2):
            with closing(SqliteStore.open(self.path, 0.0)) as store:
                self.assertEqual(store.get(KEY, tombstones=True), self.kept)
                self.assertEqual((store.noted("identity"), store.origin, store.rotten), (DOG.seed, "kept", 0))
                self.assertNotEqual(store.epoch, bytes(8))
                store.put(record("a"), FOREVER)
        with closing(sqlite3.connect(self.path)) as connection:
            self.assertEqual(connection.execute("PRAGMA user_version").fetchone(), (SCHEMA_VERSION,))
            self.assertEqual(connection.execute("SELECT count(*) FROM rotten").fetchone(), (1,))
            names = connection.execute("SELECT name FROM sqlite_schema WHERE type = 'table' ORDER BY name").fetchall()
        self.assertEqual(names, [("notes",), ("records",), ("rotten",)])

    def test_all_or_nothing(self) -> None:
        """A migration for which there is no room leaves the old file as it was, to be taken over later."""
        with closing(sqlite3.connect(self.path, isolation_level=None)) as connection:
            connection.text_factory = bytes
            connection.execute("PRAGMA max_page_count = 1")
            error = self.assertRaises(sqlite3.OperationalError, make, connection, 1)
            self.assertIn("full", str(error))
            self.assertFalse(connection.in_transaction)
        self.test_migrates()
