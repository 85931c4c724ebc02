"""SQLite store: what a node holds, in a file that outlives it.

Reads are answered from memory.  Changes go to the file through one writer thread that commits many of them at once,
because a single commit can stall for a quarter of a second on a busy card.  ``read_records`` reads the file for the
pages, from any thread.
"""

from __future__ import annotations

import fcntl
import os
import sqlite3
import threading
from urllib.parse import quote

from twisted.logger import Logger

from middleware.entangled.errors import BadStore, NotRunning, Refused
from middleware.entangled.record import Record, Slot, unpacked
from middleware.entangled.store import MAX_ROWS, MemoryStore

APPLICATION_ID = 0x53574E31
"""Says in the file's header that the file is ours ("SWN1")."""
SCHEMA_VERSION = 1
SCHEMA = (
    "CREATE TABLE records(key BLOB, owner BLOB, name TEXT, sequence INTEGER, lifetime TEXT, ttl REAL, value BLOB,"
    " signature BLOB, PRIMARY KEY(key, owner, name)) WITHOUT ROWID",
    "CREATE TABLE notes(name TEXT PRIMARY KEY, value BLOB)",
    f"PRAGMA application_id = {APPLICATION_ID}",
    f"PRAGMA user_version = {SCHEMA_VERSION}",
)
SELECT = "SELECT key, name, owner, sequence, lifetime, ttl, value, signature FROM records"

COMMIT_AFTER = 0.02
"""Seconds that a change waits for others to share its commit.  More spares the card; less is lost with the power."""
COMMIT_FULL = 200
"""Changes that are committed without waiting."""
TRY_AGAIN = 0.5
"""Seconds between two tries to write what could not be written, as on a full disk."""


class SqliteStore(MemoryStore):
    """A ``Store`` with the file ``path`` behind it; ``open`` makes one.

    While the file cannot be written (a full disk, say) reads go on, ``put`` raises ``Refused`` with the reason, and
    what is owed to the file is tried again until it succeeds.
    """

    _log = Logger()

    def __init__(self, path: str, connection: sqlite3.Connection, lock: int, max_rows: int) -> None:
        super().__init__(max_rows)
        self._path = path
        self._connection = connection
        self._lock = lock
        self._turn = threading.Condition()
        # All of these belong to whoever holds the turn.
        self._owed: dict[Slot, Record | None] = {}
        self._owed_notes: dict[str, bytes] = {}
        self._writing = False
        self._hurry = False
        self._closing = False
        self._trouble = ""
        self._thread = threading.Thread(target=self._write_on, name=f"writer of {path}", daemon=True)

    @classmethod
    def open(cls, path: str | os.PathLike[str], now: float, max_rows: int = MAX_ROWS) -> SqliteStore:
        """The store in the file ``path``, made if there is none; raises ``BadStore`` with the reason and a remedy.

        Team records are back, to expire a whole ttl from ``now`` (the file cannot know how long it lay); leased ones
        are gone, for their owners' leases ended with the node that watched them.
        """
        path = os.fspath(path)
        lock = _locked(path)
        connection = None
        try:
            # Autocommit: transactions are begun by hand.  One thread at a time uses the connection, this one until the
            # start.
            connection = sqlite3.connect(path, isolation_level=None, check_same_thread=False, timeout=5.0)
            version = _checked_version(path, connection)
            # Only now, for the file of another program is left as it was.
            os.fchmod(lock, 0o600)
            _begin(connection, version)
            store = cls(path, connection, lock, max_rows)
            store._load(now)
        except BaseException as error:
            if connection is not None:
                connection.close()
            os.close(lock)
            if isinstance(error, sqlite3.Error | OSError):
                raise _bad(path, str(error), "move it away, or name another file") from error
            raise
        store._thread.start()
        return store

    def put(self, record: Record, expires_at: float) -> bool:
        """Hold ``record`` if it beats what its slot holds; see ``Store.put``.  It is in the file after ``flush``."""
        self._check_open()
        if self._trouble and record.beats(self.slot(record.slot)):
            raise Refused(f"store {self._path} cannot be written: {self._trouble}")
        if not super().put(record, expires_at):
            return False
        self._owe({record.slot: record})
        return True

    def expire(self, now: float) -> list[Record]:
        """Let go of what has run out by ``now`` and return it, the earliest first."""
        return self._let_go(super().expire(now))

    def drop_leased(self, owner: bytes) -> list[Record]:
        """Let go of all leased records of ``owner`` and return them in the order of their slots."""
        return self._let_go(super().drop_leased(owner))

    def discard(self, slot: Slot) -> bool:
        """Let go of what ``slot`` holds, and say whether it held anything."""
        held = super().discard(slot)
        if held:
            self._owe({slot: None})
        return held

    def note(self, name: str, value: bytes) -> None:
        """Keep a small fact of the node's own under ``name``; it is in the file after ``flush``."""
        self._check_open()
        if self.noted(name) != value:
            super().note(name, value)
            with self._turn:
                self._owed_notes[name] = value
                self._turn.notify_all()

    def flush(self, timeout: float = 5.0) -> None:
        """Wait until all that was put is in the file; raises ``BadStore`` where that takes over ``timeout`` seconds."""
        with self._turn:
            self._hurry = bool(self._owed or self._owed_notes)
            self._turn.notify_all()
            if not self._turn.wait_for(lambda: not (self._owed or self._owed_notes or self._writing), timeout):
                raise _bad(self._path, f"not written within {timeout} s: {self._trouble or 'slow'}", "make room for it")

    def close(self) -> None:
        """Write what is to be written and let go of the file; may be called twice.

        Where it cannot be written the reason is logged: what was owed to the file is lost with this node.
        """
        with self._turn:
            if self._closing:
                return
            self._closing = True
            self._turn.notify_all()
        self._thread.join()
        self._connection.close()
        # After the connection, for closing any descriptor of the file ends SQLite's own locks on it.
        os.close(self._lock)

    # -- the caller's side -------------------------------------------------------------------------------------------

    def _load(self, now: float) -> None:
        """Take in what an earlier life left; only before the writer runs."""
        self._connection.execute("DELETE FROM records WHERE lifetime = 'leased'")
        for row in self._connection.execute(SELECT + " ORDER BY key, owner, name"):
            record = unpacked(list(row))
            if record is None:
                self._log.warn("{path} holds a row that is no record; it is passed over", path=self._path)
            else:
                self._insert(record, now + record.ttl)
        for name, value in self._connection.execute("SELECT name, value FROM notes"):
            super().note(name, value)

    def _check_open(self) -> None:
        if self._closing:
            raise NotRunning(f"store {self._path} is closed")

    def _let_go(self, records: list[Record]) -> list[Record]:
        if records:
            self._owe({record.slot: None for record in records})
        return records

    def _owe(self, changes: dict[Slot, Record | None]) -> None:
        with self._turn:
            # The last word on a slot is enough, so what is owed never outgrows what was held.
            self._owed.update(changes)
            self._turn.notify_all()

    # -- the writer's side -------------------------------------------------------------------------------------------

    def _write_on(self) -> None:
        """Write until the store is closed, and then until nothing is owed or nothing can be written."""
        ended = False
        while not ended:
            owed, notes = self._take()
            trouble = self._commit(owed, notes) if owed or notes else ""
            ended = self._settle(owed, notes, trouble)

    def _take(self) -> tuple[dict[Slot, Record | None], dict[str, bytes]]:
        """Wait until it is worth committing, and take what is owed."""
        with self._turn:
            if self._trouble:
                self._turn.wait_for(lambda: self._closing, TRY_AGAIN)
            self._turn.wait_for(lambda: self._owed or self._owed_notes or self._closing)
            self._turn.wait_for(lambda: len(self._owed) >= COMMIT_FULL or self._hurry or self._closing, COMMIT_AFTER)
            owed, self._owed = self._owed, {}
            notes, self._owed_notes = self._owed_notes, {}
            self._writing = True
            return owed, notes

    def _settle(self, owed: dict[Slot, Record | None], notes: dict[str, bytes], trouble: str) -> bool:
        """Take back what could not be written, tell whoever waits, and say whether it is time to end."""
        with self._turn:
            if trouble:
                self._owed = {**owed, **self._owed}
                self._owed_notes = {**notes, **self._owed_notes}
            if trouble != self._trouble:
                self._log.warn("store {path}: {what}", path=self._path, what=trouble or "can be written again")
            left = len(self._owed) + len(self._owed_notes)
            self._trouble = trouble
            self._writing = False
            self._hurry = self._hurry and left > 0
            self._turn.notify_all()
            if self._closing and trouble:
                self._log.error("store {path}: {left} changes are lost: {why}", path=self._path, left=left, why=trouble)
            return self._closing and (bool(trouble) or not left)

    def _commit(self, owed: dict[Slot, Record | None], notes: dict[str, bytes]) -> str:
        """Write all of it in one transaction; returns what went wrong."""
        kept = [_row(record) for record in owed.values() if record is not None]
        gone = [tuple(slot) for slot, record in owed.items() if record is None]
        try:
            self._connection.execute("BEGIN IMMEDIATE")
            self._connection.executemany("REPLACE INTO records VALUES (?, ?, ?, ?, ?, ?, ?, ?)", kept)
            self._connection.executemany("DELETE FROM records WHERE key = ? AND owner = ? AND name = ?", gone)
            self._connection.executemany("REPLACE INTO notes VALUES (?, ?)", notes.items())
            self._connection.execute("COMMIT")
        except sqlite3.Error as error:
            if self._connection.in_transaction:
                self._connection.execute("ROLLBACK")
            return str(error)
        return ""


def read_records(path: str | os.PathLike[str], key: bytes) -> list[Record]:
    """The records under ``key`` in the file ``path``, in the order of (owner, name); for any thread or process.

    Never blocks the writer; sees what was committed, up to ``COMMIT_AFTER`` late.  Raises ``BadStore``.
    """
    path = os.fspath(path)
    connection = None
    try:
        connection = sqlite3.connect(f"file:{quote(path)}?mode=ro", uri=True, timeout=1.0)
        rows = connection.execute(SELECT + " WHERE key = ? AND value IS NOT NULL ORDER BY owner, name", (key,))
        return [record for record in (unpacked(list(row)) for row in rows) if record is not None]
    except sqlite3.Error as error:
        raise _bad(path, str(error), "is it the store of a running node?") from error
    finally:
        if connection is not None:
            connection.close()


def _row(record: Record) -> tuple[object, ...]:
    key, owner, name = record.slot
    return (key, owner, name, record.sequence, record.lifetime, record.ttl, record.value, record.signature)


def _bad(path: str, problem: str, remedy: str) -> BadStore:
    # SQLite may find several lines for what is wrong; people get one.
    return BadStore(f"store {path}: {' '.join(problem.split())}; {remedy}")


def _locked(path: str) -> int:
    """A descriptor of the file that keeps other nodes off it; the file is made if there is none."""
    if os.path.isdir(path):
        raise _bad(path, "is a directory", "name a file in it")
    try:
        # Only its owner may read it: the seed of the node's identity lies in it.
        lock = os.open(path, os.O_RDWR | os.O_CREAT, 0o600)
    except OSError as error:
        raise _bad(path, error.strerror or str(error), "name a file that can be written") from error
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        os.close(lock)
        raise _bad(path, "another node uses it", "stop that one, or name another file") from error
    except OSError as error:
        os.close(lock)
        raise _bad(path, error.strerror or str(error), "name a file of your own on a local disk") from error
    return lock


def _checked_version(path: str, connection: sqlite3.Connection) -> int:
    """The schema version of the file, 0 where it is empty; raises ``BadStore`` where it is not ours or not whole."""
    (application,) = connection.execute("PRAGMA application_id").fetchone()
    (version,) = connection.execute("PRAGMA user_version").fetchone()
    (tables,) = connection.execute("SELECT count(*) FROM sqlite_schema").fetchone()
    if application != APPLICATION_ID and (application or version or tables):
        raise _bad(path, "is the database of another program", "name another file")
    if version > SCHEMA_VERSION:
        raise _bad(path, f"has schema {version}, we know {SCHEMA_VERSION}", "update it, or name another file")
    (verdict,) = connection.execute("PRAGMA quick_check(1)").fetchone()
    if verdict != "ok":
        raise _bad(path, f"is damaged ({verdict})", "move it away; the team holds copies of its records")
    return int(version)


def _begin(connection: sqlite3.Connection, version: int) -> None:
    """Make the file ready to be written; it has no tables yet where ``version`` is 0."""
    connection.execute("PRAGMA journal_mode = WAL")
    # Robots lose power at any moment; with less than FULL the last commits would be gone.
    connection.execute("PRAGMA synchronous = FULL")
    connection.execute("PRAGMA cache_size = -512")
    if not version:
        connection.execute("BEGIN IMMEDIATE")
        for statement in SCHEMA:
            connection.execute(statement)
        connection.execute("COMMIT")
