"""The thread that writes a SQLite file, with many changes in one commit.

A single commit can stall for a quarter of a second on a busy flash card, so callers do not block on commits: changes
are queued, and ``wait_for_write`` fires when they are durable.  A change that a caller waits for is committed
immediately, together with all changes queued during the previous commit; other changes share a later commit.
"""

from __future__ import annotations

import sqlite3
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

from twisted.internet.defer import Deferred, fail, succeed
from twisted.logger import Logger

from middleware.entangled.data.schema import DELETE_RECORD, PUT_NOTE, PUT_RECORD, Statement, make_note_row, make_row
from middleware.entangled.errors import BadStore, NotRunning, Unwritable
from middleware.entangled.record import Record, Slot

COMMIT_AFTER_S = 0.02
"""Seconds for which a change may wait for further changes if no caller waits for it.  A higher value causes fewer
writes to the flash card; with a lower value fewer changes are lost in a power failure."""
MAX_BATCH = 200
"""If at least this number of changes is pending, they are committed without waiting."""
RETRY_INTERVAL_S = 0.5
"""Seconds between two attempts after a failed commit, as on a full disk."""

CallInThread = Callable[[Callable[[], None]], object]
"""Calls a function in the thread that uses the store, such as ``reactor.callFromThread``."""


@dataclass
class _Batch:
    """Pending changes: only the last change of each slot and note, so a batch is never larger than the store."""

    statements: list[Statement] = field(default_factory=list)
    changes: dict[Slot, Record | None] = field(default_factory=dict)
    notes: dict[str, bytes] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.statements) + len(self.changes) + len(self.notes)

    def merge(self, later: _Batch) -> _Batch:
        """Return the changes of this batch followed by ``later``."""
        return _Batch(
            self.statements + later.statements, {**self.changes, **later.changes}, {**self.notes, **later.notes}
        )


class Writer:
    """Writes changes to ``connection``, the file ``path``, from ``start`` to ``close``.

    ``call_in_thread`` is used to notify callers of written changes in their thread; if it is None, ``flush`` and
    ``close`` notify them.
    """

    _log = Logger()

    def __init__(self, path: str, connection: sqlite3.Connection, call_in_thread: CallInThread | None) -> None:
        self._path = path
        self._connection = connection
        self._call_in_thread = call_in_thread
        self._condition = threading.Condition()
        # Access to the following attributes needs the lock of ``_condition``.
        self._pending = _Batch()
        self._waiting: list[Deferred[None]] = []
        self._is_writing = False
        self._is_urgent = False
        self._is_closing = False
        self._error = ""
        # The writer's thread appends items, the caller's thread removes them.
        self._notifications: deque[tuple[Deferred[None], str]] = deque()
        self._thread = threading.Thread(target=self._run, name=f"writer of {path}", daemon=True)

    @property
    def error(self) -> str:
        """The reason why the last commit failed; empty if it succeeded."""
        return self._error

    @property
    def is_closed(self) -> bool:
        """Whether ``close`` has been called."""
        return self._is_closing

    # -- the caller's thread -------------------------------------------------------------------------------------------

    def start(self, statements: list[Statement]) -> None:
        """Start the thread, which executes ``statements`` first."""
        self._pending.statements += statements
        self._thread.start()

    def queue_change(self, slot: Slot, record: Record | None) -> None:
        """Queue the change of ``slot`` to ``record``, or to empty."""
        with self._condition:
            self._pending.changes[slot] = record
            self._condition.notify_all()

    def queue_note(self, name: str, value: bytes) -> None:
        """Queue the change of a note."""
        with self._condition:
            self._pending.notes[name] = value
            self._condition.notify_all()

    def wait_for_write(self) -> Deferred[None]:
        """Fire once all queued changes are in the file; fail with ``Unwritable`` as soon as a commit fails."""
        with self._condition:
            if self._is_closing:
                return fail(NotRunning(f"store {self._path} is closed"))
            if self._error:
                return fail(self.make_error(self._error))
            if not self._pending and not self._is_writing:
                return succeed(None)
            waiting: Deferred[None] = Deferred()
            self._waiting.append(waiting)
            self._is_urgent = True
            self._condition.notify_all()
            return waiting

    def flush(self, timeout: float) -> None:
        """Block until all queued changes are in the file; raise ``BadStore`` after ``timeout`` seconds."""
        with self._condition:
            self._is_urgent = True
            self._condition.notify_all()
            done = self._condition.wait_for(lambda: not self._pending and not self._is_writing, timeout)
        self._notify_waiting()
        if not done:
            why = self._error or "slow"
            raise BadStore(f"store {self._path}: not written within {timeout} s: {why}; free disk space and retry")

    def close(self) -> bool:
        """Write queued changes and end the thread; return False if the writer was already closed.

        If the file is not writable, the queued changes are lost, and the reason is logged.
        """
        with self._condition:
            if self._is_closing:
                return False
            self._is_closing = True
            self._condition.notify_all()
        self._thread.join()
        self._notify_waiting()
        return True

    def make_error(self, why: str) -> Unwritable:
        """Return the error for callers if the file is not writable."""
        # The text is also sent to peers, so it does not contain the path, which is in the log.
        return Unwritable(f"the data store cannot be written: {why}")

    def _notify_waiting(self) -> None:
        """Notify waiting callers; runs in the caller's thread."""
        while self._notifications:
            waiting, error = self._notifications.popleft()
            if waiting.called:
                continue  # the caller has cancelled the Deferred
            if error:
                waiting.errback(self.make_error(error))
            else:
                waiting.callback(None)

    # -- the writer's thread -------------------------------------------------------------------------------------------

    def _run(self) -> None:
        """Write until the store is closed; then write the remaining changes, or stop at a failed commit."""
        ended = False
        while not ended:
            batch, waiting = self._take_batch()
            error = self._commit(batch) if batch else ""
            ended = self._finish_batch(batch, waiting, error)
            if self._notifications and self._call_in_thread is not None:
                self._call_in_thread(self._notify_waiting)

    def _take_batch(self) -> tuple[_Batch, list[Deferred[None]]]:
        """Wait until a commit is due; return the pending changes and the Deferreds that wait for them."""
        with self._condition:
            if self._error:
                self._condition.wait_for(lambda: self._is_closing, RETRY_INTERVAL_S)
            self._condition.wait_for(lambda: self._pending or self._is_closing)
            self._condition.wait_for(
                lambda: len(self._pending) >= MAX_BATCH or self._is_urgent or self._is_closing, COMMIT_AFTER_S
            )
            batch, self._pending = self._pending, _Batch()
            waiting, self._waiting = self._waiting, []
            self._is_urgent = False
            self._is_writing = True
            return batch, waiting

    def _finish_batch(self, batch: _Batch, waiting: list[Deferred[None]], error: str) -> bool:
        """Requeue the changes of a failed commit, schedule notifications, and return whether to end the thread."""
        with self._condition:
            if error:
                self._pending = batch.merge(self._pending)
            if error or not self._pending:
                waiting += self._waiting
                self._waiting = []
            self._notifications.extend((each, error) for each in waiting)
            if error != self._error:
                self._log.warn("store {path}: {what}", path=self._path, what=error or "writable again")
            self._error = error
            self._is_writing = False
            self._condition.notify_all()
            lost_changes = len(self._pending)
            if self._is_closing and error:
                self._log.error(
                    "store {path}: {left} changes are lost: {why}", path=self._path, left=lost_changes, why=error
                )
            return self._is_closing and (bool(error) or not lost_changes)

    def _commit(self, batch: _Batch) -> str:
        """Write the batch in one transaction; return the error, empty if none."""
        connection = self._connection
        try:
            connection.execute("BEGIN IMMEDIATE")
            for sql, values in batch.statements:
                connection.execute(sql, values)
            connection.executemany(DELETE_RECORD, (slot for slot, record in batch.changes.items() if record is None))
            connection.executemany(PUT_RECORD, (make_row(r) for r in batch.changes.values() if r is not None))
            connection.executemany(PUT_NOTE, (make_note_row(*note) for note in batch.notes.items()))
            connection.execute("COMMIT")
        except Exception as error:  # after any error the waiting callers must be notified
            return f"{' '.join(str(error).split()) or type(error).__name__}{self._roll_back()}"
        return ""

    def _roll_back(self) -> str:
        try:
            self._connection.rollback()
        except sqlite3.Error as error:
            return f"; {error}"
        return ""
