"""SQLite store: what a node holds, in a file that outlives it.

Reads are answered from memory; changes go to the file through one ``writer``.  ``read_records`` reads the file for the
pages, from any thread.
"""

from __future__ import annotations

import fcntl
import os
import sqlite3
from collections.abc import Callable
from urllib.parse import quote

from twisted.internet.defer import Deferred
from twisted.logger import Logger

from middleware.entangled.data.salvage import is_ours, saved_notes, set_aside
from middleware.entangled.data.schema import (
    SELECT,
    Contents,
    Rotten,
    checked_version,
    contents,
    make,
    open_rows,
    record_of,
)
from middleware.entangled.data.store import HOLD, MAX_BYTES, MAX_ROWS, Durable, Origin, Store
from middleware.entangled.data.writer import Deliver, Writer
from middleware.entangled.errors import BadStore, NotRunning
from middleware.entangled.record import Record, Slot

SYNCHRONOUS: dict[Durable, str] = {"power": "FULL", "crash": "NORMAL"}
EPOCH = "epoch"
"""The note that holds the store's epoch; it never goes from one file to the next."""
MAX_LOG = 4 * 2**20
"""Bytes to which the write-ahead log is cut after a flood of writes."""


class SqliteStore(Store):
    """A ``Store`` with the file ``path`` behind it; ``open`` makes one.

    While the file cannot be written (a full disk, say) reads go on, ``put`` raises ``Unwritable`` with the reason, and
    what is owed to the file is tried again until it succeeds.
    """

    _log = Logger()
    make_writer: Callable[[str, sqlite3.Connection, Deliver | None], Writer] = Writer
    """What writes the file; simulations put in one that has no thread."""

    def __init__(
        self,
        path: str,
        connection: sqlite3.Connection,
        lock: int,
        writer: Writer,
        max_rows: int,
        max_bytes: int,
        hold: float,
        epoch: bytes,
    ) -> None:
        super().__init__(max_rows, max_bytes, hold, epoch)
        self._path = path
        self._connection = connection
        self._lock = lock
        self._writer = writer

    @classmethod
    def open(
        cls,
        path: str | os.PathLike[str],
        now: float,
        max_rows: int = MAX_ROWS,
        max_bytes: int = MAX_BYTES,
        hold: float = HOLD,
        deliver: Deliver | None = None,
        fresh_epoch: bytes | None = None,
        durable: Durable = "power",
    ) -> SqliteStore:
        """The store in the file ``path``, made if there is none; raises ``BadStore`` with the reason and a remedy.

        Team records are back, to expire a whole ttl from ``now`` (the file cannot know how long it lay); leased ones
        are gone, for their owners' leases ended with the node that watched them.  A rotten file is set aside and the
        store starts empty, with those notes that could be saved.  ``deliver`` is ``reactor.callFromThread``, or None
        where nobody awaits ``written``; ``fresh_epoch`` is the epoch if the store is made now (None: drawn).
        ``durable`` is what ``written`` stands for: that it outlives a loss of ``power``, or only the ``crash`` of this
        process, which spares a wait for the disk at each commit; with the power the last commits may then go, but
        nothing else.
        """
        path = os.fspath(path)
        fresh_epoch = os.urandom(8) if fresh_epoch is None else fresh_epoch
        notes: dict[str, bytes] = {}
        origin: Origin = "kept"
        try:
            connection, lock, version, found = _opened(path, durable)
        except Rotten as error:
            aside = set_aside(path)
            notes = saved_notes(aside)
            notes.pop(EPOCH, None)
            saved = f"its notes were saved ({', '.join(notes)})" if notes else "nothing in it could be saved"
            cls._log.error(
                "store {path} was rotten ({why}); it is set aside as {aside}, and the node starts with an empty one; "
                "{saved}",
                path=path,
                why=error,
                aside=aside,
                saved=saved,
            )
            connection, lock, version, found = _opened(path, durable)
            origin = "replaced"
        if not version and origin == "kept":
            origin = "new"
        epoch = found.notes.get(EPOCH, fresh_epoch)
        writer = cls.make_writer(path, connection, deliver)
        store = cls(path, connection, lock, writer, max_rows, max_bytes, hold, epoch)
        store.origin = origin
        store._take_in(found, now)
        writer.start(found.repairs)
        for name, value in {**notes, EPOCH: epoch}.items():
            store.note(name, value)
        return store

    def put(self, record: Record, expires_at: float) -> bool:
        """Hold ``record`` if it beats what its slot holds; see ``Store.put``."""
        self._check_open()
        if self._writer.trouble and record.beats(self.slot(record.slot)):
            raise self._writer.refusal(self._writer.trouble)
        return super().put(record, expires_at)

    def written(self) -> Deferred[None]:
        """Fire when all that was put until now is in the file; fail with ``Unwritable`` if it cannot be written."""
        return self._writer.written()

    @property
    def trouble(self) -> str:
        """Why the file cannot be written at present; empty if it can."""
        return self._writer.trouble

    def note(self, name: str, value: bytes) -> None:
        """Keep a small fact of the node's own under ``name``; it is in the file once ``written`` fires."""
        self._check_open()
        if self.noted(name) != value:
            super().note(name, value)
            self._writer.owe_note(name, value)

    def flush(self, timeout: float = 5.0) -> None:
        """Wait until all that was put is in the file; raises ``BadStore`` where that takes over ``timeout`` seconds."""
        self._writer.flush(timeout)

    def close(self) -> None:
        """Write what is to be written and let go of the file; may be called twice.

        Where it cannot be written the reason is logged: what was owed to the file is lost with this node.
        """
        if self._writer.close():
            self._connection.close()
            # After the connection, for closing any descriptor of the file ends SQLite's own locks on it.
            os.close(self._lock)

    # -- inside ------------------------------------------------------------------------------------------------------

    def _take_in(self, found: Contents, now: float) -> None:
        """Take in what an earlier life left; only before the writer runs."""
        for record in found.records:
            self._insert(record, now + record.ttl)
        self._notes.update(found.notes)
        self.rotten = found.rotten
        if found.rotten:
            self._log.warn(
                "store {path}: {count} rotten rows are set aside; they are absent until their replicas repair them",
                path=self._path,
                count=found.rotten,
            )

    def _check_open(self) -> None:
        if self._writer.is_closed:
            raise NotRunning(f"store {self._path} is closed")

    def _changed(self, slot: Slot, record: Record | None) -> None:
        self._writer.owe(slot, record)


def read_records(path: str | os.PathLike[str], key: bytes) -> list[Record]:
    """The records under ``key`` in the file ``path``, in the order of (owner, name); for any thread or process.

    Never blocks the writer; sees what was committed, up to ``writer.COMMIT_AFTER`` late.  Raises ``BadStore``.
    """
    path = os.fspath(path)
    connection = None
    try:
        connection = sqlite3.connect(f"file:{quote(path)}?mode=ro", uri=True, timeout=1.0)
        open_rows(connection)
        rows = connection.execute(SELECT + " WHERE key = ? AND value IS NOT NULL ORDER BY owner, name", (key,))
        return [record for record in map(record_of, rows) if record is not None]
    except sqlite3.Error as error:
        raise _bad(path, str(error), "is it the store of a running node?") from error
    finally:
        if connection is not None:
            connection.close()


def _opened(path: str, durable: Durable) -> tuple[sqlite3.Connection, int, int, Contents]:
    """The file, locked and made ready to be written, the version that it had, and what it holds.

    Raises ``BadStore`` where it cannot be used, ``Rotten`` where it is ours and damaged.
    """
    lock = _locked(path)
    connection = None
    try:
        # Autocommit: transactions are begun by hand.  One thread at a time uses the connection, this one until the
        # writer starts.
        connection = sqlite3.connect(path, isolation_level=None, check_same_thread=False, timeout=5.0)
        open_rows(connection)
        version = checked_version(path, connection)
        # Only now, for the file of another program is left as it was.
        os.fchmod(lock, 0o600)
        connection.execute("PRAGMA journal_mode = WAL")
        # Robots lose power at any moment; with less than FULL the last commits would be gone.  Less than NORMAL could
        # damage the file.
        connection.execute(f"PRAGMA synchronous = {SYNCHRONOUS[durable]}")
        connection.execute("PRAGMA cache_size = -512")
        connection.execute(f"PRAGMA journal_size_limit = {MAX_LOG}")
        make(connection, version)
        return connection, lock, version, contents(connection)
    except BaseException as error:
        if connection is not None:
            connection.close()
        if isinstance(error, sqlite3.Error) and error.sqlite_errorcode in (
            sqlite3.SQLITE_CORRUPT,
            sqlite3.SQLITE_NOTADB,
        ):
            ours = is_ours(path)
            os.close(lock)
            if ours:
                raise Rotten(_line(error)) from error
            raise _bad(path, str(error), "name another file") from error
        os.close(lock)
        if isinstance(error, sqlite3.Error | OSError):
            raise _bad(path, str(error), "make room, or name another file") from error
        raise


def _line(problem: object) -> str:
    # SQLite may find several lines for what is wrong; people get one.
    return " ".join(str(problem).split())


def _bad(path: str, problem: str, remedy: str) -> BadStore:
    return BadStore(f"store {path}: {_line(problem)}; {remedy}")


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
        holder = _holder(lock)
        os.close(lock)
        who = "another node uses it" + (f" (process {holder})" if holder else "")
        raise _bad(path, who, "stop that one, or give each node a store of its own: its identity lies there") from error
    except OSError as error:
        os.close(lock)
        raise _bad(path, error.strerror or str(error), "name a file of your own on a local disk") from error
    return lock


def _holder(lock: int) -> int:
    """The process that has locked the file; 0 where the system does not tell."""
    inode = os.fstat(lock).st_ino
    try:
        with open("/proc/locks", encoding="ascii") as lines:
            rows = [line.split() for line in lines]
    except (OSError, ValueError):
        return 0
    # "12: FLOCK  ADVISORY  WRITE 4711 00:2d:1234 0 EOF"
    held = [row[4] for row in rows if len(row) > 5 and row[1] == "FLOCK" and row[5].rpartition(":")[2] == str(inode)]
    return int(held[0]) if held and held[0].isdecimal() else 0
