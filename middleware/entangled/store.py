"""Store: the records that a node holds, and the few facts that it keeps for itself.

``MemoryStore`` forgets when the node ends; ``sqlite.SqliteStore`` is the same with a file behind it.  Moments are in
seconds on one clock of the caller, who says when something expires and what the time is.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass
from typing import Protocol

from middleware.entangled.errors import Refused
from middleware.entangled.record import Record, Slot

MAX_ROWS = 20_000
"""Slots that a node holds.  More serves a larger network; less spares memory (about 1 KiB a row) and card."""


class Store(Protocol):
    """What every data store does; one thread uses it."""

    def put(self, record: Record, expires_at: float) -> bool:
        """Hold ``record`` if it beats what its slot holds, and say whether it did.

        The very record that is already held only stays longer.  Raises ``Refused`` where there is no room for a new
        slot, or where it cannot be written.
        """

    def get(self, key: bytes, tombstones: bool = False) -> list[Record]:
        """The records under ``key`` in the order of (owner, name); ``tombstones``: with the empty slots."""

    def slot(self, slot: Slot) -> Record | None:
        """What ``slot`` holds, be it a tombstone."""

    def expiry(self, slot: Slot) -> float | None:
        """When what ``slot`` holds runs out, or None where it holds nothing."""

    def owned(self, owner: bytes) -> list[Record]:
        """The records of ``owner``, tombstones included, in the order of their slots."""

    def extend(self, owner: bytes, expires_at: float) -> int:
        """Let all leased records of ``owner`` live until ``expires_at`` at least; returns how many there are."""

    def expire(self, now: float) -> list[Record]:
        """Let go of what has run out by ``now`` and return it, the earliest first."""

    def drop_leased(self, owner: bytes) -> list[Record]:
        """Let go of all leased records of ``owner`` (it said goodbye) and return them in the order of their slots."""

    def discard(self, slot: Slot) -> bool:
        """Let go of what ``slot`` holds, whatever its lifetime, and say whether it held anything."""

    def records(self) -> list[Record]:
        """Every record, tombstones included, in the order in which their slots came."""

    def keys(self) -> list[bytes]:
        """Every key that has a slot, in the order in which they came."""

    def note(self, name: str, value: bytes) -> None:
        """Keep a small fact of the node's own (its seed, its contacts) under ``name``."""

    def noted(self, name: str) -> bytes | None:
        """The fact kept under ``name``, or None."""

    def close(self) -> None:
        """Write what is to be written and let go; may be called twice."""

    def __len__(self) -> int:
        """How many slots are held, the empty ones included."""


@dataclass
class _Held:
    """A record with its expiry; ``queued_at`` is the moment under which the heap knows it."""

    record: Record
    expires_at: float
    queued_at: float


class MemoryStore:
    """A ``Store`` that lives as long as the program.

    ``max_rows`` slots at most.  A tombstone is let in above that, for a delete must never fail for want of room, up to
    as many slots again, for nobody shall fill the memory with them.
    """

    def __init__(self, max_rows: int = MAX_ROWS) -> None:
        self._max_rows = max_rows
        self._slots: dict[Slot, _Held] = {}
        self._by_key: dict[bytes, dict[Slot, _Held]] = {}
        self._by_owner: dict[bytes, dict[Slot, _Held]] = {}
        self._sorted: dict[bytes, list[Record]] = {}
        self._heap: list[tuple[float, Slot]] = []
        self._notes: dict[str, bytes] = {}

    def __len__(self) -> int:
        """How many slots are held, the empty ones included."""
        return len(self._slots)

    def put(self, record: Record, expires_at: float) -> bool:
        """Hold ``record`` if it beats what its slot holds; see ``Store.put``."""
        slot = record.slot
        held = self._slots.get(slot)
        if held is None:
            self._check_room(record)
            self._insert(record, expires_at)
        elif record.beats(held.record):
            held.record, held.expires_at = record, expires_at
            if expires_at < held.queued_at:
                self._queue(held)
        else:
            if record == held.record:
                held.expires_at = max(held.expires_at, expires_at)
            return False
        self._sorted.pop(slot.key, None)
        return True

    def get(self, key: bytes, tombstones: bool = False) -> list[Record]:
        """The records under ``key``; see ``Store.get``."""
        records = self._sorted.get(key)
        if records is None:
            slots = self._by_key.get(key)
            if slots is None:
                return []
            # Large keys are read page by page, so the order is worth keeping between two changes.
            records = self._sorted[key] = [slots[slot].record for slot in sorted(slots)]
        return list(records) if tombstones else [record for record in records if not record.is_tombstone]

    def slot(self, slot: Slot) -> Record | None:
        """What ``slot`` holds, be it a tombstone."""
        held = self._slots.get(slot)
        return held.record if held else None

    def expiry(self, slot: Slot) -> float | None:
        """When what ``slot`` holds runs out, or None where it holds nothing."""
        held = self._slots.get(slot)
        return held.expires_at if held else None

    def owned(self, owner: bytes) -> list[Record]:
        """The records of ``owner``, tombstones included, in the order of their slots."""
        slots = self._by_owner.get(owner, {})
        return [slots[slot].record for slot in sorted(slots)]

    def extend(self, owner: bytes, expires_at: float) -> int:
        """Let all leased records of ``owner`` live until ``expires_at`` at least; returns how many there are."""
        leased = 0
        for held in self._by_owner.get(owner, {}).values():
            if held.record.lifetime == "leased":
                # The heap is not told: it will find out at the old moment and look again at the new one.
                held.expires_at = max(held.expires_at, expires_at)
                leased += 1
        return leased

    def expire(self, now: float) -> list[Record]:
        """Let go of what has run out by ``now`` and return it, the earliest first."""
        gone: list[tuple[float, Slot, Record]] = []
        while self._heap and self._heap[0][0] <= now:
            queued_at, slot = heapq.heappop(self._heap)
            held = self._slots.get(slot)
            if held is None or held.queued_at != queued_at:
                continue
            if held.expires_at > now:
                self._queue(held)
            else:
                gone.append((held.expires_at, slot, self._remove(slot)))
        # One whose lease was extended comes off the heap at its old moment.
        gone.sort(key=lambda ended: ended[:2])
        return [record for _, _, record in gone]

    def drop_leased(self, owner: bytes) -> list[Record]:
        """Let go of all leased records of ``owner`` and return them in the order of their slots."""
        return [self._remove(record.slot) for record in self.owned(owner) if record.lifetime == "leased"]

    def discard(self, slot: Slot) -> bool:
        """Let go of what ``slot`` holds, and say whether it held anything."""
        held = slot in self._slots
        if held:
            self._remove(slot)
        return held

    def records(self) -> list[Record]:
        """Every record, tombstones included, in the order in which their slots came."""
        return [held.record for held in self._slots.values()]

    def keys(self) -> list[bytes]:
        """Every key that has a slot, in the order in which they came."""
        return list(self._by_key)

    def note(self, name: str, value: bytes) -> None:
        """Keep a small fact of the node's own under ``name``."""
        self._notes[name] = value

    def noted(self, name: str) -> bytes | None:
        """The fact kept under ``name``, or None."""
        return self._notes.get(name)

    def close(self) -> None:
        """Do nothing: what is in memory needs no goodbye."""

    def _check_room(self, record: Record) -> None:
        room = 2 * self._max_rows if record.is_tombstone else self._max_rows
        if len(self._slots) >= room:
            raise Refused(f"store full: it holds {len(self._slots)} of {room} slots; remove some, or allow more rows")

    def _insert(self, record: Record, expires_at: float) -> None:
        slot = record.slot
        held = _Held(record, expires_at, expires_at)
        self._slots[slot] = held
        self._by_key.setdefault(slot.key, {})[slot] = held
        self._by_owner.setdefault(slot.owner, {})[slot] = held
        self._queue(held)

    def _queue(self, held: _Held) -> None:
        held.queued_at = held.expires_at
        heapq.heappush(self._heap, (held.expires_at, held.record.slot))
        if len(self._heap) > 2 * len(self._slots) + 64:
            # What was dropped or shortened leaves its old moment behind; whoever does that on purpose shall not fill
            # the memory.
            self._heap = [(other.queued_at, slot) for slot, other in self._slots.items()]
            heapq.heapify(self._heap)

    def _remove(self, slot: Slot) -> Record:
        held = self._slots.pop(slot)
        for index, name in ((self._by_key, slot.key), (self._by_owner, slot.owner)):
            del index[name][slot]
            if not index[name]:
                del index[name]
        self._sorted.pop(slot.key, None)
        return held.record
