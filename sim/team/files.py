"""Simulate nodes with stores in real SQLite files that lose power between any two instructions.

The writer has no thread: it commits at times of the simulated clock, so that a run follows from its seed.  A kill
leaves the files as they are, possibly with a torn commit at their end; the next life opens a copy.
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
from middleware.entangled.data.writer import COMMIT_AFTER, TRY_AGAIN, Writer, _Owed
from middleware.entangled.network.switchboard import CALM, Weather
from middleware.entangled.record import Record, Slot
from sim.team.world import Fleet

PARTS = ("", "-wal")
MEMORY = "/dev/shm"
"""A folder in memory, if the machine has it: the tests do not depend on the real disk."""

Facts = dict[Slot | str, Record | bytes | None]
"""The content of slots and notes."""


class TurnedWriter(Writer):
    """A writer that commits at times of its clock; with ``fault`` set, every commit fails for that reason."""

    def __init__(self, path: str, connection: sqlite3.Connection, clock: HeapClock, rng: random.Random) -> None:
        super().__init__(path, connection, lambda tell: clock.callLater(0.0, tell))
        self.fault = ""
        self._clock = clock
        self._rng = rng
        self._timer: IDelayedCall | None = None

    def start(self, statements: list[Any]) -> None:
        """Start to write, ``statements`` first."""
        self._owed.statements += statements
        self._schedule()

    def owe(self, slot: Slot, record: Record | None) -> None:
        """Schedule ``record`` to be written as the content of ``slot``; None clears the slot."""
        super().owe(slot, record)
        self._schedule()

    def owe_note(self, name: str, value: bytes) -> None:
        """Schedule a note to be written."""
        super().owe_note(name, value)
        self._schedule()

    def turn(self) -> None:
        """Commit all pending changes."""
        self._timer = None
        batch, self._owed = self._owed, _Owed()
        waiting, self._waiting = self._waiting, []
        self._writing = True
        self._settle(batch, waiting, self._commit(batch) if batch else "")
        if self._news and self._deliver is not None:
            self._deliver(self._tell)
        self._schedule()

    def tear(self) -> None:
        """Commit all pending changes without an acknowledgement: the power fails meanwhile."""
        self._commit(self._owed)

    def abandon(self) -> None:
        """Stop at once."""
        self._closing = True
        if self._timer is not None and self._timer.active():
            self._timer.cancel()

    def _commit(self, batch: _Owed) -> str:
        return self.fault or super()._commit(batch)

    def _schedule(self) -> None:
        if self._timer is None and self._owed and not self._closing:
            wait = TRY_AGAIN if self._trouble else self._rng.uniform(0.0, COMMIT_AFTER)
            self._timer = self._clock.callLater(wait, self.turn)


class DiskStore(SqliteStore):
    """A store that records acknowledged writes in ``promised``, and later changes in ``fresh``."""

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self.promised: Facts = {}
        self.fresh: Facts = {}

    @property
    def writer(self) -> TurnedWriter:
        """The writer of the file."""
        assert isinstance(self._writer, TurnedWriter)
        return self._writer

    def note(self, name: str, value: bytes) -> None:
        """Store a note of the node under ``name``."""
        self.fresh[name] = value
        super().note(name, value)

    def written(self) -> Deferred[None]:
        """Fire when all writes until now are in the file."""
        until_now = dict(self.fresh)

        def safe(_: None) -> None:
            self.promised.update(until_now)
            for place, fact in until_now.items():
                if self.fresh.get(place) is fact:
                    self.fresh.pop(place, None)

        return super().written().addCallback(safe)

    def lost(self, later: SqliteStore) -> list[str]:
        """Return the acknowledged writes that are missing in the store of the ``later`` life."""
        lost = []
        for place, fact in self.promised.items():
            if place in self.fresh:
                continue
            there = later.noted(place) if isinstance(place, str) else later.slot(place)
            if isinstance(fact, Record) and fact.lifetime == "leased":
                continue
            if there != fact:
                lost.append(f"{place if isinstance(place, str) else place.name}: {_short(fact)} became {_short(there)}")
        return lost

    def abandon(self) -> None:
        """Close the file as a kill does."""
        self.writer.abandon()
        self._connection.close()
        os.close(self._lock)

    def _changed(self, slot: Slot, record: Record | None) -> None:
        self.fresh[slot] = record
        super()._changed(slot, record)


class DiskFleet(Fleet):
    """Nodes with stores in files of a temporary folder.

    ``decay`` maps places to the kind of corruption ("row" or "file") at their next kill; ``lost`` lists acknowledged
    writes that were missing in the next life, ``overlooked`` corruption that was not detected.
    """

    def __init__(self, n: int, seed: int = 1, weather: Weather = CALM) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="schedule-", dir=MEMORY if os.path.isdir(MEMORY) else None)
        self._disk_rng = random.Random(f"{seed}/disk")
        self._memories: Counter[int] = Counter()
        self._corrupt: set[int] = set()
        self.decay: dict[int, str] = {}
        self.decayed: list[int] = []
        self.lost: list[str] = []
        self.overlooked: list[str] = []
        super().__init__(n, seed, weather)

    def memory(self, place: int) -> int:
        """Return the number of the store of the node at a place."""
        return self._memories[place]

    def disk(self, place: int) -> DiskStore:
        """Return the store of the node at a place."""
        store = self.stores[place]
        assert isinstance(store, DiskStore)
        return store

    def store(self, place: int) -> Store:
        """Open the store of the next life of the node at this place."""
        former = self.stores.get(place)
        store = self.stores[place] = self._open_store(self._path(place))
        if place in self._corrupt:
            self._corrupt.discard(place)
            if not store.rotten and store.origin != "replaced":
                self.overlooked.append(f"node {place} does not detect that its store is corrupt")
        elif isinstance(former, DiskStore):
            self.lost += [f"node {place} lost an acknowledged write: {line}" for line in former.lost(store)]
        return store

    def kill(self, place: int, forgets: bool = True) -> None:
        """Kill a node as a loss of power does: its file stays as it is, or has half a commit.

        The next life may lack recent writes that are not in the file yet, and the file may be corrupted.
        """
        super().kill(place, forgets)
        store, path = self.disk(place), self._path(place)
        self._memories[place] += 1
        later = self._path(place)
        before = _size(path + "-wal")
        is_torn = self._disk_rng.random() < 0.5
        if is_torn:
            store.writer.tear()
        _copy(path, later)
        after = _size(later + "-wal")
        if is_torn and after > before:
            os.truncate(later + "-wal", self._disk_rng.randrange(before, after + 1))
        store.abandon()
        kind = self.decay.get(place)
        if kind is not None and self._corrupt_file(later, kind):
            del self.decay[place]
            self._corrupt.add(place)
            self.decayed.append(place)

    def stop(self) -> None:
        """End every node, and remove the files."""
        super().stop()
        for place in range(len(self.nodes)):
            store = self.disk(place)
            if not store.writer.is_closed:
                store.abandon()
        self._folder.cleanup()

    def differing(self, place: int) -> list[str]:
        """Compare a node's memory with the content that its file would give after a kill now."""
        store, path = self.disk(place), f"{self._path(place)}-copy"
        _copy(self._path(place), path)
        copy = self._open_store(path)
        here = {record for record in store.records() if record.lifetime == "team"}
        there = set(copy.records())
        found = []
        if here != there:
            found.append(
                f"node {place}: its file lacks {len(here - there)} records, and has {len(there - here)} too many"
            )
        copy.abandon()
        return found

    # -- inside -----------------------------------------------------------------------------------------------------

    def _path(self, place: int) -> str:
        return str(Path(self._folder.name) / f"{place}-{self._memories[place]}")

    def _open_store(self, path: str) -> DiskStore:
        dice = random.Random(f"{self._disk_rng.random()}/{Path(path).name}")
        clock = self.clock

        class Store(DiskStore):
            make_writer = staticmethod(
                # Only the file name, without the folder: refusals name it to peers, and the folder varies.
                lambda path, connection, deliver: TurnedWriter(Path(path).name, connection, clock, dice)
            )

        store = Store.open(path, clock.seconds(), fresh_epoch=dice.randbytes(8))
        assert isinstance(store, DiskStore)
        return store

    def _corrupt_file(self, path: str, kind: str) -> bool:
        """Corrupt a row or the file; returns whether there was content to corrupt."""
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


def _copy(path: str, to: str) -> None:
    for part in PARTS:
        if os.path.exists(path + part):
            shutil.copyfile(path + part, to + part)


def _size(path: str) -> int:
    return os.path.getsize(path) if os.path.exists(path) else 0


def _short(fact: object) -> str:
    return f"number {fact.sequence}" if isinstance(fact, Record) else repr(fact)[:40]
