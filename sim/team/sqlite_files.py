"""Simulate nodes that have stores in real SQLite files and lose power between any two instructions.

The writer has no thread: it commits at times of the simulated clock, so a run follows from its seed. A kill does not
change the files, which may end with an incomplete commit; the next life of the node opens a copy.
"""

from __future__ import annotations

import os
import random
import shutil
import sqlite3
import tempfile
from collections import Counter
from contextlib import closing
from pathlib import Path
from typing import Any

from twisted.internet.defer import Deferred
from twisted.internet.interfaces import IDelayedCall

from middleware.entangled.clock import HeapClock
from middleware.entangled.data.sqlite import SqliteStore
from middleware.entangled.data.store import Store
from middleware.entangled.data.writer_thread import COMMIT_AFTER_S, RETRY_INTERVAL_S, Writer, _Batch
from middleware.entangled.network.switchboard import PERFECT, LinkConditions
from middleware.entangled.record import Record, Slot
from sim.team.simulation import EntangledTeam

FILE_SUFFIXES = ("", "-wal")
MEMORY_FOLDER = "/dev/shm"
"""A folder in memory, used if the machine has it, so that the tests do not depend on the speed of the disk."""

Content = dict[Slot | str, Record | bytes | None]
"""The content of slots and notes."""


class ClockedWriter(Writer):
    """A writer that commits at times of its clock; if ``fault`` is set, every commit fails for that reason."""

    def __init__(self, path: str, connection: sqlite3.Connection, clock: HeapClock, rng: random.Random) -> None:
        super().__init__(path, connection, lambda tell: clock.callLater(0.0, tell))
        self.fault = ""
        self._clock = clock
        self._rng = rng
        self._timer: IDelayedCall | None = None

    def start(self, statements: list[Any]) -> None:
        """Start writing; ``statements`` are executed first."""
        self._pending.statements += statements
        self._schedule()

    def queue_change(self, slot: Slot, record: Record | None) -> None:
        """Schedule ``record`` to be written as the content of ``slot``; None clears the slot."""
        super().queue_change(slot, record)
        self._schedule()

    def queue_note(self, name: str, value: bytes) -> None:
        """Schedule a note to be written."""
        super().queue_note(name, value)
        self._schedule()

    def commit_pending(self) -> None:
        """Commit all pending changes."""
        self._timer = None
        batch, self._pending = self._pending, _Batch()
        waiting, self._waiting = self._waiting, []
        self._is_writing = True
        self._finish_batch(batch, waiting, self._commit(batch) if batch else "")
        if self._notifications and self._call_in_thread is not None:
            self._call_in_thread(self._notify_waiting)
        self._schedule()

    def commit_unacknowledged(self) -> None:
        """Commit all pending changes, but acknowledge none: the power fails during the commit."""
        self._commit(self._pending)

    def abandon(self) -> None:
        """Stop immediately."""
        self._is_closing = True
        if self._timer is not None and self._timer.active():
            self._timer.cancel()

    def _commit(self, batch: _Batch) -> str:
        return self.fault or super()._commit(batch)

    def _schedule(self) -> None:
        if self._timer is None and self._pending and not self._is_closing:
            wait = RETRY_INTERVAL_S if self._error else self._rng.uniform(0.0, COMMIT_AFTER_S)
            self._timer = self._clock.callLater(wait, self.commit_pending)


class CheckedStore(SqliteStore):
    """A store that records acknowledged writes in ``acknowledged``, and later changes in ``unacknowledged``."""

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self.acknowledged: Content = {}
        self.unacknowledged: Content = {}

    @property
    def writer(self) -> ClockedWriter:
        """The writer of the file."""
        assert isinstance(self._writer, ClockedWriter)
        return self._writer

    def set_note(self, name: str, value: bytes) -> None:
        """Store a note of the node under ``name``."""
        self.unacknowledged[name] = value
        super().set_note(name, value)

    def wait_for_write(self) -> Deferred[None]:
        """Fire when all writes until now are in the file."""
        until_now = dict(self.unacknowledged)

        def safe(_: None) -> None:
            self.acknowledged.update(until_now)
            for place, fact in until_now.items():
                if self.unacknowledged.get(place) is fact:
                    self.unacknowledged.pop(place, None)

        return super().wait_for_write().addCallback(safe)

    def find_lost(self, later: SqliteStore) -> list[str]:
        """Return the acknowledged writes that are missing in the store of the ``later`` life."""
        lost = []
        for place, fact in self.acknowledged.items():
            if place in self.unacknowledged:
                continue
            there = later.get_note(place) if isinstance(place, str) else later.get_slot(place)
            if isinstance(fact, Record) and fact.lifetime == "leased":
                continue
            if there != fact:
                lost.append(
                    f"{place if isinstance(place, str) else place.name}: {_describe(fact)} became {_describe(there)}"
                )
        return lost

    def abandon(self) -> None:
        """Close the file as a kill does."""
        self.writer.abandon()
        self._connection.close()
        os.close(self._lock)

    def _on_changed(self, slot: Slot, record: Record | None) -> None:
        self.unacknowledged[slot] = record
        super()._on_changed(slot, record)


class SqliteTeam(EntangledTeam):
    """Nodes with stores in files of a temporary folder.

    ``planned_corruption`` maps the place of a node to the kind of corruption ("row" or "file") of its store when the
    node is next killed. ``lost`` lists acknowledged writes that were missing after the restart; ``undetected`` lists
    corruptions that the node did not detect.
    """

    def __init__(self, n: int, seed: int = 1, conditions: LinkConditions = PERFECT) -> None:
        self._folder = tempfile.TemporaryDirectory(
            prefix="schedule-", dir=MEMORY_FOLDER if os.path.isdir(MEMORY_FOLDER) else None
        )
        self._disk_rng = random.Random(f"{seed}/disk")
        self._store_numbers: Counter[int] = Counter()
        self._corrupt: set[int] = set()
        self.planned_corruption: dict[int, str] = {}
        self.corrupted: list[int] = []
        self.lost: list[str] = []
        self.undetected: list[str] = []
        super().__init__(n, seed, conditions)

    def get_store_number(self, place: int) -> int:
        """Return the number of the store of the node at a place."""
        return self._store_numbers[place]

    def get_store(self, place: int) -> CheckedStore:
        """Return the store of the node at a place."""
        store = self.stores[place]
        assert isinstance(store, CheckedStore)
        return store

    def store(self, place: int) -> Store:
        """Open the store of the next life of the node at this place."""
        former = self.stores.get(place)
        store = self.stores[place] = self._open_store(self._get_path(place))
        if place in self._corrupt:
            self._corrupt.discard(place)
            if not store.corrupt_rows and store.origin != "replaced":
                self.undetected.append(f"node {place} does not detect that its store is corrupt")
        elif isinstance(former, CheckedStore):
            self.lost += [f"node {place} lost an acknowledged write: {line}" for line in former.find_lost(store)]
        return store

    def kill(self, place: int, forgets: bool = True) -> None:
        """Kill a node as by a loss of power: its file does not change, or has an incomplete commit.

        The next life may lack recent writes that are not in the file yet, and the file may be corrupted.
        """
        super().kill(place, forgets)
        store, path = self.get_store(place), self._get_path(place)
        self._store_numbers[place] += 1
        later = self._get_path(place)
        before = _measure_size(path + "-wal")
        is_torn = self._disk_rng.random() < 0.5
        if is_torn:
            store.writer.commit_unacknowledged()
        _copy_files(path, later)
        after = _measure_size(later + "-wal")
        if is_torn and after > before:
            os.truncate(later + "-wal", self._disk_rng.randrange(before, after + 1))
        store.abandon()
        kind = self.planned_corruption.get(place)
        if kind is not None and self._corrupt_file(later, kind):
            del self.planned_corruption[place]
            self._corrupt.add(place)
            self.corrupted.append(place)

    def stop(self) -> None:
        """End every node, and remove the files."""
        super().stop()
        for place in range(len(self.nodes)):
            store = self.get_store(place)
            if not store.writer.is_closed:
                store.abandon()
        self._folder.cleanup()

    def compare_content(self, place: int) -> list[str]:
        """Compare a node's memory with the content that would be read from its file after a kill now."""
        store, path = self.get_store(place), f"{self._get_path(place)}-copy"
        _copy_files(self._get_path(place), path)
        copy = self._open_store(path)
        here = {record for record in store.records() if record.lifetime == "team"}
        there = set(copy.records())
        found = []
        if here != there:
            found.append(
                f"node {place}: its file lacks {len(here - there)} records, and has {len(there - here)} wrong records"
            )
        copy.abandon()
        return found

    # -- inside -----------------------------------------------------------------------------------------------------

    def _get_path(self, place: int) -> str:
        return str(Path(self._folder.name) / f"{place}-{self._store_numbers[place]}")

    def _open_store(self, path: str) -> CheckedStore:
        rng = random.Random(f"{self._disk_rng.random()}/{Path(path).name}")
        clock = self.clock

        class Store(CheckedStore):
            make_writer = staticmethod(
                # Use the file name without the folder, which varies: errors that are sent to peers contain this name.
                lambda path, connection, deliver: ClockedWriter(Path(path).name, connection, clock, rng)
            )

        store = Store.open(path, clock.seconds(), fresh_epoch=rng.randbytes(8))
        assert isinstance(store, CheckedStore)
        return store

    def _corrupt_file(self, path: str, kind: str) -> bool:
        """Corrupt a row or the file; return False if there was no content to corrupt."""
        with closing(sqlite3.connect(path, isolation_level=None)) as connection:
            rows = [row for (row,) in connection.execute("SELECT id FROM records WHERE value IS NOT NULL ORDER BY id")]
            if not rows:
                return False
            if kind == "row":
                for row in rows:
                    connection.execute("UPDATE records SET value = value || x'00' WHERE id = ?", (row,))
            connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        if kind == "file":
            with open(path, "r+b") as file:
                file.seek(4096)
                file.write(self._disk_rng.randbytes(4096))
        return True


def _copy_files(path: str, to: str) -> None:
    for part in FILE_SUFFIXES:
        if os.path.exists(path + part):
            shutil.copyfile(path + part, to + part)


def _measure_size(path: str) -> int:
    return os.path.getsize(path) if os.path.exists(path) else 0


def _describe(fact: object) -> str:
    return f"number {fact.sequence}" if isinstance(fact, Record) else repr(fact)[:40]
