"""The thread that writes a SQLite file, with many changes to a commit.

A single commit can stall for a quarter of a second on a busy flash card, so callers do not block on it: changes are
queued, and ``written`` fires when they are durable.  A change that a caller waits for is committed at once, together
with all changes queued during the commit before; other changes share a later commit.
"""

from __future__ import annotations

import sqlite3
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

from twisted.internet.defer import Deferred, fail, succeed
from twisted.logger import Logger

from middleware.entangled.data.schema import DELETE, NOTE, PUT, Statement, note_of, row_of
from middleware.entangled.errors import BadStore, NotRunning, Unwritable
from middleware.entangled.record import Record, Slot

COMMIT_AFTER = 0.02
"""Seconds that a change may wait for others if no caller waits for it.  More means fewer writes to the card; less means
fewer changes lost in a power failure."""
COMMIT_FULL = 200
"""Pending changes that are committed without waiting."""
TRY_AGAIN = 0.5
"""Seconds between two attempts after a failed commit, as on a full disk."""

Deliver = Callable[[Callable[[], None]], object]
"""Calls a function in the thread of the store's user: ``reactor.callFromThread``."""


@dataclass
class _Owed:
    """Pending changes: only the last one of each slot and note, so they never exceed the store's size."""

    statements: list[Statement] = field(default_factory=list)
    changes: dict[Slot, Record | None] = field(default_factory=dict)
    notes: dict[str, bytes] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.statements) + len(self.changes) + len(self.notes)

    def before(self, later: _Owed) -> _Owed:
        """Return the changes of this batch followed by ``later``."""
        return _Owed(
            self.statements + later.statements, {**self.changes, **later.changes}, {**self.notes, **later.notes}
        )


class Writer:
    """Writes changes to ``connection``, the file ``path``, from ``start`` to ``close``.

    ``deliver`` notifies of written changes in the caller's thread; if it is None, ``flush`` and ``close`` do.
    """

    _log = Logger()

    def __init__(self, path: str, connection: sqlite3.Connection, deliver: Deliver | None) -> None:
        self._path = path
        self._connection = connection
        self._deliver = deliver
        self._turn = threading.Condition()
        # Access to these needs the lock of ``_turn``.
        self._owed = _Owed()
        self._waiting: list[Deferred[None]] = []
        self._writing = False
        self._hurry = False
        self._closing = False
        self._trouble = ""
        # The writer appends, the caller's thread pops.
        self._news: deque[tuple[Deferred[None], str]] = deque()
        self._thread = threading.Thread(target=self._write_on, name=f"writer of {path}", daemon=True)

    @property
    def trouble(self) -> str:
        """The reason why the last commit failed; empty if it succeeded."""
        return self._trouble

    @property
    def is_closed(self) -> bool:
        """Whether ``close`` has been called."""
        return self._closing

    # -- the caller's thread -------------------------------------------------------------------------------------------

    def start(self, statements: list[Statement]) -> None:
        """Start the thread, which executes ``statements`` first."""
        self._owed.statements += statements
        self._thread.start()

    def owe(self, slot: Slot, record: Record | None) -> None:
        """Queue the change of ``slot`` to ``record``, or to empty."""
        with self._turn:
            self._owed.changes[slot] = record
            self._turn.notify_all()

    def owe_note(self, name: str, value: bytes) -> None:
        """Queue the change of a note."""
        with self._turn:
            self._owed.notes[name] = value
            self._turn.notify_all()

    def written(self) -> Deferred[None]:
        """Fire once all changes queued so far are in the file; fail with ``Unwritable`` as soon as a commit fails."""
        with self._turn:
            if self._closing:
                return fail(NotRunning(f"store {self._path} is closed"))
            if self._trouble:
                return fail(self.refusal(self._trouble))
            if not self._owed and not self._writing:
                return succeed(None)
            waiting: Deferred[None] = Deferred()
            self._waiting.append(waiting)
            self._hurry = True
            self._turn.notify_all()
            return waiting

    def flush(self, timeout: float) -> None:
        """Block until all queued changes are in the file; raise ``BadStore`` after ``timeout`` seconds."""
        with self._turn:
            self._hurry = True
            self._turn.notify_all()
            done = self._turn.wait_for(lambda: not self._owed and not self._writing, timeout)
        self._tell()
        if not done:
            why = self._trouble or "slow"
            raise BadStore(f"store {self._path}: not written within {timeout} s: {why}; free disk space and retry")

    def close(self) -> bool:
        """Write queued changes and end the thread; return False if that was done before.

        If the file is not writable the queued changes are lost and the reason is logged.
        """
        with self._turn:
            if self._closing:
                return False
            self._closing = True
            self._turn.notify_all()
        self._thread.join()
        self._tell()
        return True

    def refusal(self, why: str) -> Unwritable:
        """Return the error for callers while the file is not writable."""
        # Sent to peers as well: without the path, which is in the log.
        return Unwritable(f"the data store cannot be written: {why}")

    def _tell(self) -> None:
        """Notify waiting callers; runs in the caller's thread."""
        while self._news:
            waiting, trouble = self._news.popleft()
            if waiting.called:
                continue  # cancelled by its caller
            if trouble:
                waiting.errback(self.refusal(trouble))
            else:
                waiting.callback(None)

    # -- the writer's thread -------------------------------------------------------------------------------------------

    def _write_on(self) -> None:
        """Write until the store is closed, and then until no changes are left or a commit fails."""
        ended = False
        while not ended:
            batch, waiting = self._take()
            trouble = self._commit(batch) if batch else ""
            ended = self._settle(batch, waiting, trouble)
            if self._news and self._deliver is not None:
                self._deliver(self._tell)

    def _take(self) -> tuple[_Owed, list[Deferred[None]]]:
        """Wait until a commit is due; return the pending changes and the Deferreds that wait for them."""
        with self._turn:
            if self._trouble:
                self._turn.wait_for(lambda: self._closing, TRY_AGAIN)
            self._turn.wait_for(lambda: self._owed or self._closing)
            self._turn.wait_for(lambda: len(self._owed) >= COMMIT_FULL or self._hurry or self._closing, COMMIT_AFTER)
            batch, self._owed = self._owed, _Owed()
            waiting, self._waiting = self._waiting, []
            self._hurry = False
            self._writing = True
            return batch, waiting

    def _settle(self, batch: _Owed, waiting: list[Deferred[None]], trouble: str) -> bool:
        """Requeue the changes of a failed commit, schedule notifications, and return whether to end the thread."""
        with self._turn:
            if trouble:
                self._owed = batch.before(self._owed)
            if trouble or not self._owed:
                waiting += self._waiting
                self._waiting = []
            self._news.extend((each, trouble) for each in waiting)
            if trouble != self._trouble:
                self._log.warn("store {path}: {what}", path=self._path, what=trouble or "writable again")
            self._trouble = trouble
            self._writing = False
            self._turn.notify_all()
            left = len(self._owed)
            if self._closing and trouble:
                self._log.error("store {path}: {left} changes are lost: {why}", path=self._path, left=left, why=trouble)
            return self._closing and (bool(trouble) or not left)

    def _commit(self, batch: _Owed) -> str:
        """Write the batch in one transaction; return the error, empty if none."""
        connection = self._connection
        try:
            connection.execute("BEGIN IMMEDIATE")
            for sql, values in batch.statements:
                connection.execute(sql, values)
            connection.executemany(DELETE, (slot for slot, record in batch.changes.items() if record is None))
            connection.executemany(PUT, (row_of(r) for r in batch.changes.values() if r is not None))
            connection.executemany(NOTE, (note_of(*note) for note in batch.notes.items()))
            connection.execute("COMMIT")
        except Exception as error:  # whatever the error, the waiting callers must be notified
            return f"{' '.join(str(error).split()) or type(error).__name__}{self._rolled_back()}"
        return ""

    def _rolled_back(self) -> str:
        try:
            self._connection.rollback()
        except sqlite3.Error as error:
            return f"; {error}"
        return ""
