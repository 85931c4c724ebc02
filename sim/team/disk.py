"""Simulate a store in a file: writes are durable after a delay, and a loss of power loses pending writes."""

from __future__ import annotations

import random

from twisted.internet.defer import Deferred, fail, succeed
from twisted.internet.interfaces import IReactorTime

from middleware.entangled.data.memory import MemoryStore
from middleware.entangled.data.writer_thread import COMMIT_AFTER_S, RETRY_INTERVAL_S
from middleware.entangled.errors import Unwritable
from middleware.entangled.record import Record, Slot

FULL_MESSAGE = "database or disk is full"


class SurvivingMemory(MemoryStore):
    """A store whose whole content survives the end of its node."""

    def get_surviving(self) -> tuple[list[Record], dict[str, bytes]]:
        """Return the records and notes that would survive a loss of power now."""
        return self.records(), self._notes


class SimulatedDisk(SurvivingMemory):
    """A store that loses pending writes on a loss of power; while ``is_full`` is set, nothing can be written."""

    def __init__(self, clock: IReactorTime, rng: random.Random) -> None:
        super().__init__()
        self.is_full = False
        self.durable: dict[Slot, Record] = {}
        self.durable_notes: dict[str, bytes] = {}
        self._clock = clock
        self._rng = rng
        self._trouble = ""
        self._pending: dict[Slot, Record | None] = {}
        self._pending_notes: dict[str, bytes] = {}
        self._waiting: list[Deferred[None]] = []
        self._is_scheduled = False
        self._is_powered_off = False

    @property
    def write_error(self) -> str:
        """The reason of the last failed commit; empty after a success."""
        return self._trouble

    def put(self, record: Record, expires_at: float) -> bool:
        """Store ``record`` if it is newer than the record in its slot; see ``Store.put``."""
        if self._trouble and record.supersedes(self.get_slot(record.slot)):
            raise _make_error(self._trouble)
        return super().put(record, expires_at)

    def wait_for_write(self) -> Deferred[None]:
        """Fire when all writes until now are durable; fail with ``Unwritable`` as soon as a commit fails."""
        if self._trouble:
            return fail(_make_error(self._trouble))
        if not self._pending and not self._pending_notes:
            return succeed(None)
        waiting: Deferred[None] = Deferred()
        self._waiting.append(waiting)
        return waiting

    def set_note(self, name: str, value: bytes) -> None:
        """Store a note of the node under ``name``."""
        if self.get_note(name) != value:
            super().set_note(name, value)
            self._pending_notes[name] = value
            self._schedule()

    def mark_durable(self) -> None:
        """Make the current content durable."""
        self.durable, self.durable_notes = (
            {slot: record for slot, record in self._pending.items() if record},
            dict(self._notes),
        )
        self._pending.clear()
        self._pending_notes.clear()

    def get_surviving(self) -> tuple[list[Record], dict[str, bytes]]:
        """Return the records and notes that would survive a loss of power now."""
        return list(self.durable.values()), self.durable_notes

    def close(self) -> None:
        """Write pending changes if possible; later changes are not written."""
        self._commit()
        self.lose_power()

    def lose_power(self) -> None:
        """Stop all writing."""
        self._is_powered_off = True

    # -- inside -----------------------------------------------------------------------------------------------------

    def _on_changed(self, slot: Slot, record: Record | None) -> None:
        self._pending[slot] = record
        self._schedule()

    def _schedule(self) -> None:
        if not self._is_scheduled:
            self._is_scheduled = True
            wait = RETRY_INTERVAL_S if self._trouble else self._rng.uniform(0.0, COMMIT_AFTER_S)
            self._clock.callLater(wait, self._commit)

    def _commit(self) -> None:
        self._is_scheduled = False
        if self._is_powered_off:
            return
        self._trouble = FULL_MESSAGE if self.is_full else ""
        waiting, self._waiting = self._waiting, []
        if self._trouble:
            self._schedule()
        else:
            for slot, record in self._pending.items():
                if record is None:
                    self.durable.pop(slot, None)
                else:
                    self.durable[slot] = record
            self.durable_notes.update(self._pending_notes)
            self._pending.clear()
            self._pending_notes.clear()
        for each in waiting:
            if self._trouble:
                each.errback(_make_error(self._trouble))
            else:
                each.callback(None)


def restore_store(store: SurvivingMemory, later: SurvivingMemory, now: float) -> SurvivingMemory:
    """Fill ``later`` with the content of ``store`` that survives its node: team records and notes, but no leases.

    Team records expire a whole TTL after ``now``, because the time since the last use of a file is not known.
    """
    records, notes = store.get_surviving()
    later.origin = "kept"
    later.epoch = store.epoch
    if isinstance(later, SimulatedDisk) and isinstance(store, SimulatedDisk):
        later.is_full = store.is_full
    for record in records:
        if record.lifetime == "team":
            later.put(record, now + record.ttl)
    for name, value in notes.items():
        later.set_note(name, value)
    if isinstance(later, SimulatedDisk):
        later.mark_durable()
    return later


def _make_error(why: str) -> Unwritable:
    return Unwritable(f"the data store cannot be written: {why}")
