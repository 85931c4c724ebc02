"""Store: the records that a node holds, and the few facts that it keeps for itself.

``memory.MemoryStore`` forgets when the node ends; ``sqlite.SqliteStore`` writes to a file.  Moments are in seconds on
one clock of the caller, who says when something expires and what the time is.

Where there is no room for a record, the store removes tombstones that are older than ``hold``, the oldest first and no
more than is needed: a node that was away for longer than that joins with an empty store.  It removes nothing else for
the sake of a record: if that is not enough, the writer is told ``Full``, with figures, and nothing has changed.

One owner may have as much as it leaves free: a dynamic threshold, as in switches with a shared buffer (Choudhury and
Hahne, 1998).  Alone it has up to half of the rows and bytes; k owners that write without end leave 1 in 2**k free to
the others.  An owner that has more is refused, and only tombstones of its own make room for it.
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
"""Slots that a node holds.  More serves a larger network; less spares memory: 1.2 KiB a row beside what ``weight``
counts.  Full with ``MAX_BYTES`` a store adds some 22 MiB to a node of 40, which a device of 64 MB just bears."""
MAX_BYTES = 8 * 2**20
"""Bytes that a node holds, as ``weight`` counts them.  More holds more large values; less spares memory and card."""
HOLD = 86_400.0
"""Seconds for which a tombstone stays even where room is short: the longest absence after which a deleted record does
not come back with whoever was away.  More is safer; less gives room back earlier."""
OWNER_ROWS = 250
OWNER_BYTES = 65_536
"""Rows and bytes that each owner may have as long as there is room at all, however much others have."""
FIXED_BYTES = 17
"""Sequence (8), ttl (8) and lifetime (1) of a record."""

MAX_LOOKED_AT = 1000
"""Old tombstones that are looked at for those of one owner, the oldest first."""

Origin = Literal["new", "kept", "replaced"]
"""Where a store comes from: made now, back from its file, or made now because its file was rotten."""
Durable = Literal["power", "crash"]
"""What that which is written outlives: any loss of power, or a crash of the process only."""


class Usage(NamedTuple):
    """What a store holds and may hold."""

    rows: int
    max_rows: int
    bytes: int
    max_bytes: int

    def __str__(self) -> str:
        return f"{self.rows} of {self.max_rows} rows, {self.bytes} of {self.max_bytes} bytes"


@dataclass(slots=True)
class _Held:
    """A record with its expiry; ``queued_at`` is the moment under which the heap knows it."""

    record: Record
    expires_at: float
    queued_at: float


class Store:
    """The records of one node, in memory; one thread uses it.

    ``max_rows`` slots and ``max_bytes`` at most, and of these one owner may have as much as it leaves free.  A
    tombstone is let in above that, for a delete must never fail for want of room, up to as many slots again, for nobody
    shall fill the memory with them.  ``epoch`` is drawn when the store is made.
    """

    origin: Origin = "new"
    """Where the store comes from; what is not ``new`` to its node may be stale or empty until it is compared."""
    rotten = 0
    """Rows that failed their checksum when the store was opened; they are absent, and its replicas repair them."""

    def __init__(
        self, max_rows: int = MAX_ROWS, max_bytes: int = MAX_BYTES, hold: float = HOLD, epoch: bytes = bytes(8)
    ) -> None:
        self.epoch = epoch
        self._max_rows = max_rows
        self._max_bytes = max_bytes
        self._hold = hold
        self._now = float("-inf")
        self._bytes = 0
        self._slots: dict[Slot, _Held] = {}
        self._by_key: dict[bytes, dict[Slot, _Held]] = {}
        self._by_owner: dict[bytes, dict[Slot, _Held]] = {}
        self._bytes_of: dict[bytes, int] = {}
        # In the order in which they may be let go of.
        self._tombstones: dict[Slot, _Held] = {}
        self._made_room: list[Record] = []
        self._sorted: dict[bytes, list[_Held]] = {}
        self._heap: list[tuple[float, Slot]] = []
        self._notes: dict[str, bytes] = {}

    def __len__(self) -> int:
        """How many slots are held, the empty ones included."""
        return len(self._slots)

    @property
    def trouble(self) -> str:
        """Why nothing can be written at present; empty if it can."""
        return ""

    @property
    def usage(self) -> Usage:
        """Rows and bytes held, tombstones included, and how many may be."""
        return Usage(len(self._slots), self._max_rows, self._bytes, self._max_bytes)

    def put(self, record: Record, expires_at: float) -> bool:
        """Hold ``record`` if it beats what its slot holds, and say whether it did.

        The very record that is already held only stays longer.  Raises ``Full`` where there is no room, or its owner
        has all that one owner may have, ``Unwritable`` where it cannot be written.  It is safe, and may be
        acknowledged, once ``written`` has fired.
        """
        slot = record.slot
        held = self._slots.get(slot)
        if held is not None and not record.beats(held.record):
            if record == held.record:
                held.expires_at = max(held.expires_at, expires_at)
                self._sort_in(slot, held)
            return False
        self._make_room(record, held)
        if held is None:
            self._insert(record, expires_at)
        else:
            self._replace(held, record, expires_at)
        self._changed(slot, record)
        return True

    def written(self) -> Deferred[None]:
        """Fire when all that was put until now survives the end of the process; fail with ``Unwritable`` if not."""
        return succeed(None)

    def get(self, key: bytes, tombstones: bool = False) -> list[Record]:
        """The records under ``key`` in the order of (owner, name); ``tombstones``: with the empty slots."""
        holding = self._sorted.get(key)
        if holding is None:
            slots = self._by_key.get(key)
            if slots is None:
                return []
            # Large keys are read page by page, so the order is worth keeping between two changes.
            holding = self._sorted[key] = [slots[slot] for slot in sorted(slots)]
        return [held.record for held in holding if tombstones or held.record.value is not None]

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

    def owners(self) -> list[bytes]:
        """Every owner that has a slot, in the order in which they came."""
        return list(self._by_owner)

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
        """Let go of what has run out by ``now``; return it, the earliest first, and before it what had to make room."""
        self._now = max(self._now, now)
        made_room, self._made_room = self._made_room, []
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
        return made_room + [record for _, _, record in gone]

    def due(self) -> float:
        """The moment before which ``expire`` finds nothing to let go of; infinite where nothing is held."""
        if self._made_room:
            return float("-inf")
        return self._heap[0][0] if self._heap else float("inf")

    def drop_leased(self, owner: bytes) -> list[Record]:
        """Let go of all leased records of ``owner`` (it said goodbye) and return them in the order of their slots."""
        return [self._remove(record.slot) for record in self.owned(owner) if record.lifetime == "leased"]

    def discard(self, slot: Slot) -> bool:
        """Let go of what ``slot`` holds, whatever its lifetime, and say whether it held anything."""
        held = slot in self._slots
        if held:
            self._remove(slot)
        return held

    def records(self) -> list[Record]:
        """Every record held, tombstones included, in the order in which their slots came."""
        return [held.record for held in self._slots.values()]

    def note(self, name: str, value: bytes) -> None:
        """Keep a small fact of the node's own (its seed, its contacts) under ``name``."""
        self._notes[name] = value

    def noted(self, name: str) -> bytes | None:
        """The fact kept under ``name``, or None."""
        return self._notes.get(name)

    def close(self) -> None:
        """Write what is to be written and let go; may be called twice."""

    # -- room --------------------------------------------------------------------------------------------------------

    def _fits(self, record: Record, rows: int, size: int) -> bool:
        """Whether ``rows`` and ``size`` more are within the quota for the like of ``record``."""
        if record.is_tombstone:
            return len(self._slots) + rows <= 2 * self._max_rows
        return len(self._slots) + rows <= self._max_rows and self._bytes + size <= self._max_bytes

    def _make_room(self, record: Record, held: _Held | None) -> None:
        """Let go of what may go until ``record`` fits in the place of ``held``; raises ``Full``."""
        rows = 1 if held is None else 0
        size = weight(record) - (0 if held is None else weight(held.record))
        if not rows and size <= 0:
            return
        leaving: dict[Slot, None] = {}
        own = (slot for slot in islice(self._dispensable(record.slot), MAX_LOOKED_AT) if slot.owner == record.owner)
        while not self._is_within_part(record, rows, size):
            slot = next(own, None)
            if slot is None:
                raise Full(
                    f"store full for this owner, which has {len(self._by_owner[record.owner])} rows and"
                    f" {self._bytes_of[record.owner]} bytes: the store holds {self.usage}, and one owner may have as"
                    f" much as it leaves free; remove some, or allow the store more",
                    OWNER_FULL,
                )
            leaving[slot] = None
            rows, size = rows - 1, size - weight(self._slots[slot].record)
        candidates = (slot for slot in self._dispensable(record.slot) if slot not in leaving)
        while not self._fits(record, rows, size):
            slot = next(candidates, None)
            if slot is None:
                raise Full(f"store full: it holds {self.usage}, no room for {size} bytes; remove some, or allow more")
            leaving[slot] = None
            rows, size = rows - 1, size - weight(self._slots[slot].record)
        self._made_room += [self._remove(slot) for slot in leaving]

    def _is_within_part(self, record: Record, rows: int, size: int) -> bool:
        """Whether its owner leaves as much free as it has, with ``rows`` and ``size`` more, or has but little."""
        has_rows = len(self._by_owner.get(record.owner, ())) + rows
        has_bytes = self._bytes_of.get(record.owner, 0) + size
        free_rows = self._max_rows - len(self._slots) - rows
        free_bytes = self._max_bytes - self._bytes - size
        return has_rows <= max(OWNER_ROWS, free_rows) and (
            record.is_tombstone or has_bytes <= max(OWNER_BYTES, free_bytes)
        )

    def _dispensable(self, spared: Slot) -> Iterator[Slot]:
        """What may be let go of, in that order, but for ``spared``."""
        for slot, held in self._tombstones.items():
            if held.expires_at - held.record.ttl + self._hold > self._now:
                break
            if slot != spared:
                yield slot

    # -- inside ------------------------------------------------------------------------------------------------------

    def _changed(self, slot: Slot, record: Record | None) -> None:
        """Learn that ``slot`` holds ``record`` from now on, or nothing."""

    def _insert(self, record: Record, expires_at: float) -> None:
        slot = record.slot
        held = _Held(record, expires_at, expires_at)
        self._slots[slot] = held
        self._by_key.setdefault(slot.key, {})[slot] = held
        self._by_owner.setdefault(slot.owner, {})[slot] = held
        self._sorted.pop(slot.key, None)
        self._weigh(slot.owner, weight(record))
        self._sort_in(slot, held)
        self._queue(held)

    def _weigh(self, owner: bytes, more: int) -> None:
        self._bytes += more
        self._bytes_of[owner] = self._bytes_of.get(owner, 0) + more

    def _replace(self, held: _Held, record: Record, expires_at: float) -> None:
        self._weigh(record.owner, weight(record) - weight(held.record))
        held.record, held.expires_at = record, expires_at
        self._sort_in(record.slot, held)
        if expires_at < held.queued_at:
            self._queue(held)

    def _sort_in(self, slot: Slot, held: _Held) -> None:
        """Put ``held``, if it is a tombstone, at the end of those that wait until room is needed."""
        self._tombstones.pop(slot, None)
        if held.record.is_tombstone:
            self._tombstones[slot] = held

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
        self._weigh(slot.owner, -weight(held.record))
        if slot.owner not in self._by_owner:
            del self._bytes_of[slot.owner]
        self._tombstones.pop(slot, None)
        self._changed(slot, None)
        return held.record


def weight(record: Record) -> int:
    """What ``record`` counts against a quota: the bytes of all its fields."""
    name = len(record.name.encode())
    return len(record.key) + len(record.owner) + name + len(record.value or b"") + len(record.signature) + FIXED_BYTES
