"""A data store in a SQLite file.

Reads are served from memory; one ``Writer`` writes changes to the file.  ``read_records`` reads the file from any
thread, for the web pages.
"""

from __future__ import annotations

import fcntl
import os
import sqlite3
from collections.abc import Callable
from urllib.parse import quote

from twisted.internet.defer import Deferred
from twisted.logger import Logger

from middleware.entangled.data.recovery import is_store, read_saved_notes, set_aside
from middleware.entangled.data.schema import (
    SELECT_RECORDS,
    Contents,
    CorruptStore,
    check_version,
    create_tables,
    parse_row,
    read_contents,
    use_bytes,
)
from middleware.entangled.data.store import MAX_BYTES, MAX_ROWS, TOMBSTONE_HOLD_S, Durability, Origin, Store
from middleware.entangled.data.writer_thread import CallInThread, Writer
from middleware.entangled.errors import BadStore, NotRunning
from middleware.entangled.record import Record, Slot

SYNCHRONOUS: dict[Durability, str] = {"power": "FULL", "crash": "NORMAL"}
EPOCH_NOTE = "epoch"
"""The name of the note with the store's epoch, which is not copied from a corrupt file to the new store."""
MAX_LOG_BYTES = 4 * 2**20
"""The size in bytes to which the write-ahead log is truncated after a burst of writes."""


class SqliteStore(Store):
    """A ``Store`` backed by the file ``path``; use ``open`` to create one.

    If the file is not writable, for example on a full disk, reads continue, ``put`` raises ``Unwritable`` with the
    reason, and the writer retries the pending changes.
    """

    _log = Logger()
    make_writer: Callable[[str, sqlite3.Connection, CallInThread | None], Writer] = Writer
    """The factory of the writer; simulations replace it by a factory of writers without a thread."""

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
        hold: float = TOMBSTONE_HOLD_S,
        deliver: CallInThread | None = None,
        fresh_epoch: bytes | None = None,
        durable: Durability = "power",
    ) -> SqliteStore:
        """Open the store in the file ``path``, or create it; raise ``BadStore`` with the reason and a remedy.

        Team records expire a whole ttl after ``now``, because the time since the store was closed is unknown.  Leased
        records are removed.  A corrupt file is renamed, and the store starts empty except for the notes that could be
        read.  ``deliver`` is ``reactor.callFromThread``, or None if the caller never waits for ``wait_for_write``.
        ``fresh_epoch`` is the epoch of a new store, random if None.  With ``durable`` set to ``power``, written data
        survives a power failure.  With ``crash``, written data survives only a crash of the process.  Commits then do
        not wait for the disk, so a power failure may lose the last commits, but causes no further damage.
        """
        path = os.fspath(path)
        fresh_epoch = os.urandom(8) if fresh_epoch is None else fresh_epoch
        notes: dict[str, bytes] = {}
        origin: Origin = "kept"
        try:
            connection, lock, version, found = _open_file(path, durable)
        except CorruptStore as error:
            aside = set_aside(path)
            notes = read_saved_notes(aside)
            notes.pop(EPOCH_NOTE, None)
            saved = f"its notes were saved ({', '.join(notes)})" if notes else "nothing in it could be saved"
            cls._log.error(
                "store {path} is corrupt ({why}); it is renamed to {aside}, and the node starts with an empty store; "
                "{saved}",
                path=path,
                why=error,
                aside=aside,
                saved=saved,
            )
            connection, lock, version, found = _open_file(path, durable)
            origin = "replaced"
        if not version and origin == "kept":
            origin = "new"
        epoch = found.notes.get(EPOCH_NOTE, fresh_epoch)
        writer = cls.make_writer(path, connection, deliver)
        store = cls(path, connection, lock, writer, max_rows, max_bytes, hold, epoch)
        store.origin = origin
        store._load(found, now)
        writer.start(found.repairs)
        for name, value in {**notes, EPOCH_NOTE: epoch}.items():
            store.set_note(name, value)
        return store

    def put(self, record: Record, expires_at: float) -> bool:
        """Store ``record`` if it supersedes the record in its slot; see ``Store.put``."""
        self._check_open()
        if self._writer.error and record.supersedes(self.get_slot(record.slot)):
            raise self._writer.make_error(self._writer.error)
        return super().put(record, expires_at)

    def wait_for_write(self) -> Deferred[None]:
        """Fire when all previous changes are in the file; fail with ``Unwritable`` if it is not writable."""
        return self._writer.wait_for_write()

    @property
    def write_error(self) -> str:
        """The reason why the file is currently not writable; empty if it is writable."""
        return self._writer.error

    def set_note(self, name: str, value: bytes) -> None:
        """Store a small value for the node's own use under ``name``; it is durable when ``wait_for_write`` fires."""
        self._check_open()
        if self.get_note(name) != value:
            super().set_note(name, value)
            self._writer.queue_note(name, value)

    def flush(self, timeout: float = 5.0) -> None:
        """Block until all changes are in the file; raise ``BadStore`` after ``timeout`` seconds."""
        self._writer.flush(timeout)

    def close(self) -> None:
        """Write pending changes and close the file; may be called twice.

        If the file is not writable, the pending changes are lost, and the reason is logged.
        """
        if self._writer.close():
            self._connection.close()
            # The lock is closed last, because closing any descriptor of the file releases SQLite's locks on the file.
            os.close(self._lock)

    # -- inside ------------------------------------------------------------------------------------------------------

    def _load(self, found: Contents, now: float) -> None:
        """Load the contents of the file; only before the writer runs."""
        for record in found.records:
            self._insert(record, now + record.ttl)
        self._notes.update(found.notes)
        self.corrupt_rows = found.corrupt_rows
        if found.corrupt_rows:
            self._log.warn(
                "store {path}: {count} corrupt rows are set aside; their records are missing until replicas send them",
                path=self._path,
                count=found.corrupt_rows,
            )

    def _check_open(self) -> None:
        if self._writer.is_closed:
            raise NotRunning(f"store {self._path} is closed")

    def _on_changed(self, slot: Slot, record: Record | None) -> None:
        self._writer.queue_change(slot, record)


def read_records(path: str | os.PathLike[str], key: bytes) -> list[Record]:
    """Return the records under ``key`` in the file ``path``, in the order of (owner, name); from any thread or process.

    The call never blocks the writer.  It reads only committed changes, which are up to ``writer_thread.COMMIT_AFTER_S``
    seconds late.  Raises ``BadStore``.
    """
    path = os.fspath(path)
    connection = None
    try:
        connection = sqlite3.connect(f"file:{quote(path)}?mode=ro", uri=True, timeout=1.0)
        use_bytes(connection)
        rows = connection.execute(SELECT_RECORDS + " WHERE key = ? AND value IS NOT NULL ORDER BY owner, name", (key,))
        return [record for record in map(parse_row, rows) if record is not None]
    except sqlite3.Error as error:
        raise _make_error(path, str(error), "is it the store of a running node?") from error
    finally:
        if connection is not None:
            connection.close()


def _open_file(path: str, durable: Durability) -> tuple[sqlite3.Connection, int, int, Contents]:
    """Lock and open the file; return the connection, the lock, the previous schema version, and the contents.

    Raises ``BadStore`` if the file is not usable, ``CorruptStore`` if it is a damaged store.
    """
    lock = _lock_file(path)
    connection = None
    try:
        # Autocommit: the code begins transactions explicitly.  Only one thread at a time uses the connection; until the
        # writer starts, this is the current thread.
        connection = sqlite3.connect(path, isolation_level=None, check_same_thread=False, timeout=5.0)
        use_bytes(connection)
        version = check_version(path, connection)
        # This is done only after the check, so that a file of a different program stays unchanged.
        os.fchmod(lock, 0o600)
        connection.execute("PRAGMA journal_mode = WAL")
        # Robots lose power at any time; levels below FULL lose the last commits, levels below NORMAL may damage the
        # file.
        connection.execute(f"PRAGMA synchronous = {SYNCHRONOUS[durable]}")
        connection.execute("PRAGMA cache_size = -512")
        connection.execute(f"PRAGMA journal_size_limit = {MAX_LOG_BYTES}")
        create_tables(connection, version)
        return connection, lock, version, read_contents(connection)
    except BaseException as error:
        if connection is not None:
            connection.close()
        if isinstance(error, sqlite3.Error) and error.sqlite_errorcode in (
            sqlite3.SQLITE_CORRUPT,
            sqlite3.SQLITE_NOTADB,
        ):
            ours = is_store(path)
            os.close(lock)
            if ours:
                raise CorruptStore(_join_lines(error)) from error
            raise _make_error(path, str(error), "choose a different file") from error
        os.close(lock)
        if isinstance(error, sqlite3.Error | OSError):
            raise _make_error(path, str(error), "free disk space, or choose a different file") from error
        raise


def _join_lines(problem: object) -> str:
    # SQLite's messages may have several lines.
    return " ".join(str(problem).split())


def _make_error(path: str, problem: str, remedy: str) -> BadStore:
    return BadStore(f"store {path}: {_join_lines(problem)}; {remedy}")


def _lock_file(path: str) -> int:
    """Create or open the file and lock it against other nodes; return the descriptor."""
    if os.path.isdir(path):
        raise _make_error(path, "the path is a directory", "choose a file in it")
    try:
        # Readable only by its owner, because it contains the seed of the node's identity.
        lock = os.open(path, os.O_RDWR | os.O_CREAT, 0o600)
    except OSError as error:
        raise _make_error(path, error.strerror or str(error), "choose a file that can be written") from error
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        holder = _find_lock_holder(lock)
        os.close(lock)
        problem = "another node uses it" + (f" (process {holder})" if holder else "")
        raise _make_error(
            path, problem, "stop that node, or configure a separate store, with its own identity, for each node"
        ) from error
    except OSError as error:
        os.close(lock)
        raise _make_error(
            path, error.strerror or str(error), "the store must be your own file on a local disk"
        ) from error
    return lock


def _find_lock_holder(lock: int) -> int:
    """Return the id of the process that holds the lock, 0 if unknown."""
    inode = os.fstat(lock).st_ino
    try:
        with open("/proc/locks", encoding="ascii") as lines:
            rows = [line.split() for line in lines]
    except (OSError, ValueError):
        return 0
    # "12: FLOCK  ADVISORY  WRITE 4711 00:2d:1234 0 EOF"
    held = [row[4] for row in rows if len(row) > 5 and row[1] == "FLOCK" and row[5].rpartition(":")[2] == str(inode)]
    return int(held[0]) if held and held[0].isdecimal() else 0
