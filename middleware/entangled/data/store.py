"""The records that a node stores, and small values for its own use (notes).

``memory.MemoryStore`` stores them only in memory; ``sqlite.SqliteStore`` also writes them to a file.  Times are in
seconds of the caller's clock; the caller passes expiry times and the current time.

If there is not enough space for a record, the store removes tombstones older than ``hold``, the oldest first, and no
more than needed.  This is safe, because a node that was absent for longer than ``hold`` joins with an empty store.  The
store evicts only tombstones: if the space is still not enough, ``put`` raises ``Full`` and changes nothing.

The share of each owner is as large as the space that is still free: a dynamic threshold, as in switches with a shared
buffer (Choudhury and Hahne, 1998).  A single owner gets up to half of the rows and bytes; k owners that write without
end leave 1 in 2**k free.  A record of an owner above its share is rejected unless removing tombstones of the same owner
frees enough space.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from typing import Literal, NamedTuple

from twisted.internet.defer import Deferred, succeed

from middleware.entangled.errors import OWNER_FULL, Full
from middleware.entangled.record import Record, Slot

MAX_ROWS = 12_000
"""The maximum number of slots of a store.  A larger network needs more slots; each slot takes 1.2 KiB of memory in
addition to the ``count_bytes`` of its record.  With this value and ``MAX_BYTES``, a full store adds 22 MiB to the 40
MiB of a node; together this is the limit for a device with 64 MB."""
MAX_BYTES = 8 * 2**20
"""The maximum bytes of a store, counted by ``count_bytes``.  A higher value allows more large values, but uses more
memory and flash."""
TOMBSTONE_HOLD_S = 86_400.0
"""Seconds before a tombstone may be removed to free space: the longest absence after which a returning node does not
restore a deleted record.  A higher value is safer; a lower value frees space earlier."""
MIN_OWNER_ROWS = 250
MIN_OWNER_BYTES = 65_536
"""The share of each owner has at least this number of bytes, as long as the store has space."""
FIXED_BYTES = 17
"""The bytes of a record's sequence number (8), ttl (8) and lifetime (1)."""

MAX_SEARCHED = 1000
"""The number of tombstones, oldest first, that are searched for tombstones of a given owner."""

Origin = Literal["new", "kept", "replaced"]
"""The origin of a store: newly created, read from its file, or created because the file was corrupt."""
Durability = Literal["power", "crash"]
"""The event that written data survives: a power failure, or only a crash of the process."""


class Usage(NamedTuple):
    """Usage and limits of a store."""

    rows: int
    max_rows: int
    bytes: int
    max_bytes: int

    def __str__(self) -> str:
        return f"{self.rows} of {self.max_rows} rows, {self.bytes} of {self.max_bytes} bytes"


@dataclass(slots=True)
class _StoredRecord:
    """A record with its expiry time; ``queued_at`` is its key in the heap."""

    record: Record
    expires_at: float
    queued_at: float


class Store:
    """The records of one node, in memory; one thread uses it.

    The store has at most ``max_rows`` slots and ``max_bytes`` bytes.  A tombstone may exceed these limits, so a delete
    never fails for lack of space, but only up to twice ``max_rows`` slots, so tombstones cannot fill the memory.
    ``epoch`` is a random number that identifies this store.
    """

    origin: Origin = "new"
    """The origin of the store; unless it is ``new``, records may be stale or missing until they are reconciled."""
    corrupt_rows = 0
    """The number of corrupt rows when the store was opened; their records are missing until other replicas send
    them."""

    def __init__(
        self,
        max_rows: int = MAX_ROWS,
        max_bytes: int = MAX_BYTES,
        hold: float = TOMBSTONE_HOLD_S,
        epoch: bytes = bytes(8),
    ) -> None:
        self.epoch = epoch
        self._max_rows = max_rows
        self._max_bytes = max_bytes
        self._hold = hold
        self._now = float("-inf")
        self._bytes = 0
        self._slots: dict[Slot, _StoredRecord] = {}
        self._by_key: dict[bytes, dict[Slot, _StoredRecord]] = {}
        self._by_owner: dict[bytes, dict[Slot, _StoredRecord]] = {}
        self._bytes_of: dict[bytes, int] = {}
        # In the order of removal.
        self._tombstones: dict[Slot, _StoredRecord] = {}
        self._removed_for_room: list[Record] = []
        self._sorted: dict[bytes, list[_StoredRecord]] = {}
        self._heap: list[tuple[float, Slot]] = []
        self._notes: dict[str, bytes] = {}

    def __len__(self) -> int:
        """Return the number of slots, tombstones included."""
        return len(self._slots)

    @property
    def write_error(self) -> str:
        """The reason why the store is currently not writable; empty if it is writable."""
        return ""

    @property
    def usage(self) -> Usage:
        """Rows and bytes in use, tombstones included, and their limits."""
        return Usage(len(self._slots), self._max_rows, self._bytes, self._max_bytes)

    def put(self, record: Record, expires_at: float) -> bool:
        """Store ``record`` if it supersedes the record in its slot; return whether it was stored.

        Storing an equal record again only extends its lifetime.  Raises ``Full`` if there is no space or the owner is
        above its share, and ``Unwritable`` if the file is not writable.  The record is durable, and may be
        acknowledged, once ``wait_for_write`` has fired.
        """
        slot = record.slot
        held = self._slots.get(slot)
        if held is not None and not record.supersedes(held.record):
            if record == held.record:
                held.expires_at = max(held.expires_at, expires_at)
                self._index_tombstone(slot, held)
            return False
        self._make_room(record, held)
        if held is None:
            self._insert(record, expires_at)
        else:
            self._replace(held, record, expires_at)
        self._on_changed(slot, record)
        return True

    def wait_for_write(self) -> Deferred[None]:
        """Fire when all previous changes are durable; fail with ``Unwritable`` if they cannot be written."""
        return succeed(None)

    def get(self, key: bytes, tombstones: bool = False) -> list[Record]:
        """Return the records under ``key`` in the order of (owner, name), optionally with tombstones."""
        holding = self._sorted.get(key)
        if holding is None:
            slots = self._by_key.get(key)
            if slots is None:
                return []
            # Keys with many records are read page by page: cache the order until the next change.
            holding = self._sorted[key] = [slots[slot] for slot in sorted(slots)]
        return [held.record for held in holding if tombstones or held.record.value is not None]

    def get_slot(self, slot: Slot) -> Record | None:
        """Return the record or tombstone in ``slot``, or None."""
        held = self._slots.get(slot)
        return held.record if held else None

    def find_expiry(self, slot: Slot) -> float | None:
        """Return the expiry time of the record in ``slot``, or None."""
        held = self._slots.get(slot)
        return held.expires_at if held else None

    def find_owned(self, owner: bytes) -> list[Record]:
        """Return the records of ``owner``, tombstones included, in the order of their slots."""
        slots = self._by_owner.get(owner, {})
        return [slots[slot].record for slot in sorted(slots)]

    def owners(self) -> list[bytes]:
        """Return every owner of a slot, in order of insertion."""
        return list(self._by_owner)

    def extend_leases(self, owner: bytes, expires_at: float) -> int:
        """Extend all leased records of ``owner`` to ``expires_at`` at least; return their number."""
        leased = 0
        for held in self._by_owner.get(owner, {}).values():
            if held.record.lifetime == "leased":
                # The heap still contains the old expiry time; when that time is reached, ``expire`` queues the record
                # again.
                held.expires_at = max(held.expires_at, expires_at)
                leased += 1
        return leased

    def expire(self, now: float) -> list[Record]:
        """Remove records that expired by ``now``.

        Returns the records that were removed to free space, and then the expired records, the earliest first.
        """
        self._now = max(self._now, now)
        removed, self._removed_for_room = self._removed_for_room, []
        expired: list[tuple[float, Slot, Record]] = []
        while self._heap and self._heap[0][0] <= now:
            queued_at, slot = heapq.heappop(self._heap)
            held = self._slots.get(slot)
            if held is None or held.queued_at != queued_at:
                continue
            if held.expires_at > now:
                self._queue(held)
            else:
                expired.append((held.expires_at, slot, self._remove(slot)))
        # The heap returns a record with an extended lease at the expiry time before the extension.
        expired.sort(key=lambda ended: ended[:2])
        return removed + [record for _, _, record in expired]

    def next_expiry(self) -> float:
        """Return the next time at which ``expire`` may remove a record; infinite if the store is empty."""
        if self._removed_for_room:
            return float("-inf")
        return self._heap[0][0] if self._heap else float("inf")

    def drop_leased(self, owner: bytes) -> list[Record]:
        """Remove all leased records of ``owner``; return them in the order of their slots."""
        return [self._remove(record.slot) for record in self.find_owned(owner) if record.lifetime == "leased"]

    def discard(self, slot: Slot) -> bool:
        """Remove the record in ``slot``; return whether there was one."""
        held = slot in self._slots
        if held:
            self._remove(slot)
        return held

    def records(self) -> list[Record]:
        """Return all records, tombstones included, in the order of insertion of their slots."""
        return [held.record for held in self._slots.values()]

    def set_note(self, name: str, value: bytes) -> None:
        """Store a small value for the node's own use (its seed, its contacts) under ``name``."""
        self._notes[name] = value

    def get_note(self, name: str) -> bytes | None:
        """Return the note ``name``, or None."""
        return self._notes.get(name)

    def close(self) -> None:
        """Write pending changes and close the file; may be called twice."""

    # -- room --------------------------------------------------------------------------------------------------------

    def _fits(self, record: Record, rows: int, size: int) -> bool:
        """Return whether ``rows`` more rows and ``size`` more bytes are within the limits for ``record``."""
        if record.is_tombstone:
            return len(self._slots) + rows <= 2 * self._max_rows
        return len(self._slots) + rows <= self._max_rows and self._bytes + size <= self._max_bytes

    def _make_room(self, record: Record, held: _StoredRecord | None) -> None:
        """Remove old tombstones until ``record`` fits in place of ``held``; raise ``Full`` if it still does not fit."""
        rows = 1 if held is None else 0
        size = count_bytes(record) - (0 if held is None else count_bytes(held.record))
        if not rows and size <= 0:
            return
        leaving: dict[Slot, None] = {}
        own = (slot for slot in islice(self._find_removable(record.slot), MAX_SEARCHED) if slot.owner == record.owner)
        while not self._is_within_share(record, rows, size):
            slot = next(own, None)
            if slot is None:
                raise Full(
                    f"store full for this owner, which has {len(self._by_owner[record.owner])} rows and"
                    f" {self._bytes_of[record.owner]} bytes: the store holds {self.usage}, and an owner may have as"
                    f" much as is left free; remove some of its records, or raise the limits of the store",
                    OWNER_FULL,
                )
            leaving[slot] = None
            rows, size = rows - 1, size - count_bytes(self._slots[slot].record)
        candidates = (slot for slot in self._find_removable(record.slot) if slot not in leaving)
        while not self._fits(record, rows, size):
            slot = next(candidates, None)
            if slot is None:
                raise Full(
                    f"store full: it holds {self.usage}, no room for {size} bytes; remove some, or raise its limits"
                )
            leaving[slot] = None
            rows, size = rows - 1, size - count_bytes(self._slots[slot].record)
        self._removed_for_room += [self._remove(slot) for slot in leaving]

    def _is_within_share(self, record: Record, rows: int, size: int) -> bool:
        """Return whether the owner is within its share with ``rows`` more rows and ``size`` more bytes."""
        has_rows = len(self._by_owner.get(record.owner, ())) + rows
        has_bytes = self._bytes_of.get(record.owner, 0) + size
        free_rows = self._max_rows - len(self._slots) - rows
        free_bytes = self._max_bytes - self._bytes - size
        return has_rows <= max(MIN_OWNER_ROWS, free_rows) and (
            record.is_tombstone or has_bytes <= max(MIN_OWNER_BYTES, free_bytes)
        )

    def _find_removable(self, kept: Slot) -> Iterator[Slot]:
        """Yield the removable slots in order of removal, except ``kept``."""
        for slot, held in self._tombstones.items():
            if held.expires_at - held.record.ttl + self._hold > self._now:
                break
            if slot != kept:
                yield slot

    # -- inside ------------------------------------------------------------------------------------------------------

    def _on_changed(self, slot: Slot, record: Record | None) -> None:
        """Handle a change of ``slot`` to ``record``, or to empty."""

    def _insert(self, record: Record, expires_at: float) -> None:
        slot = record.slot
        held = _StoredRecord(record, expires_at, expires_at)
        self._slots[slot] = held
        self._by_key.setdefault(slot.key, {})[slot] = held
        self._by_owner.setdefault(slot.owner, {})[slot] = held
        self._sorted.pop(slot.key, None)
        self._count_bytes(slot.owner, count_bytes(record))
        self._index_tombstone(slot, held)
        self._queue(held)

    def _count_bytes(self, owner: bytes, more: int) -> None:
        self._bytes += more
        self._bytes_of[owner] = self._bytes_of.get(owner, 0) + more

    def _replace(self, held: _StoredRecord, record: Record, expires_at: float) -> None:
        self._count_bytes(record.owner, count_bytes(record) - count_bytes(held.record))
        held.record, held.expires_at = record, expires_at
        self._index_tombstone(record.slot, held)
        if expires_at < held.queued_at:
            self._queue(held)

    def _index_tombstone(self, slot: Slot, held: _StoredRecord) -> None:
        """Append ``held`` to the removable tombstones if it is a tombstone."""
        self._tombstones.pop(slot, None)
        if held.record.is_tombstone:
            self._tombstones[slot] = held

    def _queue(self, held: _StoredRecord) -> None:
        held.queued_at = held.expires_at
        heapq.heappush(self._heap, (held.expires_at, held.record.slot))
        if len(self._heap) > 2 * len(self._slots) + 64:
            # Removed records and shortened lifetimes leave stale entries; rebuild the heap before they fill the memory.
            self._heap = [(other.queued_at, slot) for slot, other in self._slots.items()]
            heapq.heapify(self._heap)

    def _remove(self, slot: Slot) -> Record:
        held = self._slots.pop(slot)
        for index, name in ((self._by_key, slot.key), (self._by_owner, slot.owner)):
            del index[name][slot]
            if not index[name]:
                del index[name]
        self._sorted.pop(slot.key, None)
        self._count_bytes(slot.owner, -count_bytes(held.record))
        if slot.owner not in self._by_owner:
            del self._bytes_of[slot.owner]
        self._tombstones.pop(slot, None)
        self._on_changed(slot, None)
        return held.record


def count_bytes(record: Record) -> int:
    """Return the size of all fields of ``record`` in bytes; the limits of the store use this size."""
    name = len(record.name.encode())
    return len(record.key) + len(record.owner) + name + len(record.value or b"") + len(record.signature) + FIXED_BYTES
