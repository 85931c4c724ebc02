"""Simulate a store in a file: writes are durable after a delay, and a loss of power loses pending ones."""

from __future__ import annotations

import random

from twisted.internet.defer import Deferred, fail, succeed
from twisted.internet.interfaces import IReactorTime

from middleware.entangled.data.memory import MemoryStore
from middleware.entangled.data.writer import COMMIT_AFTER, TRY_AGAIN
from middleware.entangled.errors import Unwritable
from middleware.entangled.record import Record, Slot

FULL = "database or disk is full"


class Memory(MemoryStore):
    """A store that keeps everything for its next life."""

    def kept(self) -> tuple[list[Record], dict[str, bytes]]:
        """Return the records and notes that would survive a loss of power now."""
        return self.records(), self._notes


class Disk(Memory):
    """A store that loses pending writes on a loss of power; while ``is_full`` nothing can be written."""

    def __init__(self, clock: IReactorTime, rng: random.Random) -> None:
        super().__init__()
        self.is_full = False
        self.safe: dict[Slot, Record] = {}
        self.safe_notes: dict[str, bytes] = {}
        self._clock = clock
        self._rng = rng
        self._trouble = ""
        self._pending: dict[Slot, Record | None] = {}
        self._pending_notes: dict[str, bytes] = {}
        self._waiting: list[Deferred[None]] = []
        self._is_scheduled = False
        self._is_powered_off = False

    @property
    def trouble(self) -> str:
        """The reason of the last failed commit; empty after a success."""
        return self._trouble

    def put(self, record: Record, expires_at: float) -> bool:
        """Store ``record`` if it beats the one in its slot; see ``Store.put``."""
        if self._trouble and record.beats(self.slot(record.slot)):
            raise _refusal(self._trouble)
        return super().put(record, expires_at)

    def written(self) -> Deferred[None]:
        """Fire when all writes until now are durable; fail with ``Unwritable`` as soon as a commit fails."""
        if self._trouble:
            return fail(_refusal(self._trouble))
        if not self._pending and not self._pending_notes:
            return succeed(None)
        waiting: Deferred[None] = Deferred()
        self._waiting.append(waiting)
        return waiting

    def note(self, name: str, value: bytes) -> None:
        """Store a note of the node under ``name``."""
        if self.noted(name) != value:
            super().note(name, value)
            self._pending_notes[name] = value
            self._schedule()

    def begin(self) -> None:
        """Make the present content durable."""
        self.safe, self.safe_notes = (
            {slot: record for slot, record in self._pending.items() if record},
            dict(self._notes),
        )
        self._pending.clear()
        self._pending_notes.clear()

    def kept(self) -> tuple[list[Record], dict[str, bytes]]:
        """Return the records and notes that would survive a loss of power now."""
        return list(self.safe.values()), self.safe_notes

    def close(self) -> None:
        """Write pending changes if possible, and then nothing more."""
        self._commit()
        self.lose_power()

    def lose_power(self) -> None:
        """Stop all writing."""
        self._is_powered_off = True

    # -- inside -----------------------------------------------------------------------------------------------------

    def _changed(self, slot: Slot, record: Record | None) -> None:
        self._pending[slot] = record
        self._schedule()

    def _schedule(self) -> None:
        if not self._is_scheduled:
            self._is_scheduled = True
            wait = TRY_AGAIN if self._trouble else self._rng.uniform(0.0, COMMIT_AFTER)
            self._clock.callLater(wait, self._commit)

    def _commit(self) -> None:
        self._is_scheduled = False
        if self._is_powered_off:
            return
        self._trouble = FULL if self.is_full else ""
        waiting, self._waiting = self._waiting, []
        if self._trouble:
            self._schedule()
        else:
            for slot, record in self._pending.items():
                if record is None:
                    self.safe.pop(slot, None)
                else:
                    self.safe[slot] = record
            self.safe_notes.update(self._pending_notes)
            self._pending.clear()
            self._pending_notes.clear()
        for each in waiting:
            if self._trouble:
                each.errback(_refusal(self._trouble))
            else:
                each.callback(None)


def next_life(store: Memory, later: Memory, now: float) -> Memory:
    """Fill ``later`` with the content that survives the node with ``store``: team records and notes, but no leases.

    Team records expire a whole ttl after ``now``, as a file does not know the time since its last use.
    """
    records, notes = store.kept()
    later.origin = "kept"
    later.epoch = store.epoch
    if isinstance(later, Disk) and isinstance(store, Disk):
        later.is_full = store.is_full
    for record in records:
        if record.lifetime == "team":
            later.put(record, now + record.ttl)
    for name, value in notes.items():
        later.note(name, value)
    if isinstance(later, Disk):
        later.begin()
    return later


def _refusal(why: str) -> Unwritable:
    return Unwritable(f"the data store cannot be written: {why}")
