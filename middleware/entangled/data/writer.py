"""Writer: the one thread that writes a SQLite file, many changes to a commit.

A single commit can stall for a quarter of a second on a busy card, so nobody waits for it: changes are owed to the
file, and who needs to know that they are safe is told when they are.  A change that somebody waits for is committed at
once, with all that came while the commit before it ran; one that nobody waits for shares a later commit.
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
"""Seconds that a change for which nobody waits may wait for others.  More spares the card; less loses less with the
power."""
COMMIT_FULL = 200
"""Changes that are committed without waiting."""
TRY_AGAIN = 0.5
"""Seconds between two tries to write what could not be written, as on a full disk."""

Deliver = Callable[[Callable[[], None]], object]
"""Runs a function soon in the thread of the store's caller: ``reactor.callFromThread``."""


@dataclass
class _Owed:
    """What the file lacks: the last word on each slot and note is enough, so it never outgrows what is held."""

    statements: list[Statement] = field(default_factory=list)
    changes: dict[Slot, Record | None] = field(default_factory=dict)
    notes: dict[str, bytes] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.statements) + len(self.changes) + len(self.notes)

    def before(self, later: _Owed) -> _Owed:
        """This and then ``later``."""
        return _Owed(
            self.statements + later.statements, {**self.changes, **later.changes}, {**self.notes, **later.notes}
        )


class Writer:
    """Writes to ``connection``, the file ``path``, from ``start`` to ``close``.

    ``deliver`` brings the news that something is safe to the caller's thread; without it, ``flush`` and ``close`` do.
    """

    _log = Logger()

    def __init__(self, path: str, connection: sqlite3.Connection, deliver: Deliver | None) -> None:
        self._path = path
        self._connection = connection
        self._deliver = deliver
        self._turn = threading.Condition()
        # All of these belong to whoever holds the turn.
        self._owed = _Owed()
        self._waiting: list[Deferred[None]] = []
        self._writing = False
        self._hurry = False
        self._closing = False
        self._trouble = ""
        # Appended to by the writer, emptied by the caller.
        self._news: deque[tuple[Deferred[None], str]] = deque()
        self._thread = threading.Thread(target=self._write_on, name=f"writer of {path}", daemon=True)

    @property
    def trouble(self) -> str:
        """Why the last commit failed; empty if it did not."""
        return self._trouble

    @property
    def is_closed(self) -> bool:
        """Whether ``close`` was called."""
        return self._closing

    # -- the caller's side -------------------------------------------------------------------------------------------

    def start(self, statements: list[Statement]) -> None:
        """Begin to write, ``statements`` first."""
        self._owed.statements += statements
        self._thread.start()

    def owe(self, slot: Slot, record: Record | None) -> None:
        """Have ``record`` written as what ``slot`` holds, or nothing."""
        with self._turn:
            self._owed.changes[slot] = record
            self._turn.notify_all()

    def owe_note(self, name: str, value: bytes) -> None:
        """Have a note written."""
        with self._turn:
            self._owed.notes[name] = value
            self._turn.notify_all()

    def written(self) -> Deferred[None]:
        """Fire once all that is owed now is in the file; fail with ``Unwritable`` as soon as a commit fails."""
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
        """Wait until all that is owed is in the file; raises ``BadStore`` where that takes over ``timeout`` seconds."""
        with self._turn:
            self._hurry = True
            self._turn.notify_all()
            done = self._turn.wait_for(lambda: not self._owed and not self._writing, timeout)
        self._tell()
        if not done:
            why = self._trouble or "slow"
            raise BadStore(f"store {self._path}: not written within {timeout} s: {why}; make room for it")

    def close(self) -> bool:
        """Write what is owed and end; False if that was done before.

        Where it cannot be written the reason is logged: what was owed to the file is lost with this node.
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
        """What is said to whoever wants something written while that cannot be."""
        # Peers read this as well, and where a file lies is not their business; the log names it.
        return Unwritable(f"the data store cannot be written: {why}")

    def _tell(self) -> None:
        """Pass the news on, in the caller's thread."""
        while self._news:
            waiting, trouble = self._news.popleft()
            if waiting.called:
                continue  # it was cancelled
            if trouble:
                waiting.errback(self.refusal(trouble))
            else:
                waiting.callback(None)

    # -- the writer's side -------------------------------------------------------------------------------------------

    def _write_on(self) -> None:
        """Write until the store is closed, and then until nothing is owed or nothing can be written."""
        ended = False
        while not ended:
            batch, waiting = self._take()
            trouble = self._commit(batch) if batch else ""
            ended = self._settle(batch, waiting, trouble)
            if self._news and self._deliver is not None:
                self._deliver(self._tell)

    def _take(self) -> tuple[_Owed, list[Deferred[None]]]:
        """Wait until it is worth committing, and take what is owed and who waits for it."""
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
        """Take back what could not be written, tell whoever waits, and say whether it is time to end."""
        with self._turn:
            if trouble:
                self._owed = batch.before(self._owed)
            if trouble or not self._owed:
                waiting += self._waiting
                self._waiting = []
            self._news.extend((each, trouble) for each in waiting)
            if trouble != self._trouble:
                self._log.warn("store {path}: {what}", path=self._path, what=trouble or "can be written again")
            self._trouble = trouble
            self._writing = False
            self._turn.notify_all()
            left = len(self._owed)
            if self._closing and trouble:
                self._log.error("store {path}: {left} changes are lost: {why}", path=self._path, left=left, why=trouble)
            return self._closing and (bool(trouble) or not left)

    def _commit(self, batch: _Owed) -> str:
        """Write all of it in one transaction; returns what went wrong."""
        connection = self._connection
        try:
            connection.execute("BEGIN IMMEDIATE")
            for sql, values in batch.statements:
                connection.execute(sql, values)
            connection.executemany(DELETE, (slot for slot, record in batch.changes.items() if record is None))
            connection.executemany(PUT, (row_of(r) for r in batch.changes.values() if r is not None))
            connection.executemany(NOTE, (note_of(*note) for note in batch.notes.items()))
            connection.execute("COMMIT")
        except Exception as error:  # whatever it is, those who wait must be told
            return f"{' '.join(str(error).split()) or type(error).__name__}{self._rolled_back()}"
        return ""

    def _rolled_back(self) -> str:
        try:
            self._connection.rollback()
        except sqlite3.Error as error:
            return f"; {error}"
        return ""
