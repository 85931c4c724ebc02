"""MemoryStore: the data store in memory, and the index behind every other."""

from __future__ import annotations

import heapq
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice

from twisted.internet.defer import Deferred, succeed

from middleware.entangled.data.store import HOLD, MAX_BYTES, MAX_ROWS, OWNER_BYTES, OWNER_ROWS, Origin, Usage, weight
from middleware.entangled.errors import OWNER_FULL, Full
from middleware.entangled.record import Record, Slot

MAX_LOOKED_AT = 1000
"""Old tombstones that are looked at for those of one owner, the oldest first."""


@dataclass(slots=True)
class _Held:
    """A record with its expiry; ``queued_at`` is the moment under which the heap knows it."""

    record: Record
    expires_at: float
    queued_at: float


class MemoryStore:
    """A ``Store`` that lives as long as the program.

    ``max_rows`` slots and ``max_bytes`` at most, and of these one owner may have as much as it leaves free.  A
    tombstone is let in above that, for a delete must never fail for want of room, up to as many slots again, for nobody
    shall fill the memory with them.
    """

    origin: Origin = "new"
    rotten = 0

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
        """Nothing: memory can always be written."""
        return ""

    @property
    def usage(self) -> Usage:
        """Rows and bytes held, and how many may be."""
        return Usage(len(self._slots), self._max_rows, self._bytes, self._max_bytes)

    def put(self, record: Record, expires_at: float, now: float | None = None) -> bool:
        """Hold ``record`` if it beats what its slot holds; see ``Store.put``."""
        if now is not None:
            self._now = max(self._now, now)
            if not self._fits(record, 1, weight(record)):
                self._made_room += self._run_out(now)
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
        """Fire at once: what is in memory gets no safer."""
        return succeed(None)

    def get(self, key: bytes, tombstones: bool = False) -> list[Record]:
        """The records under ``key``; see ``Store.get``."""
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
        """Let go of what has run out by ``now``; see ``Store.expire``."""
        self._now = max(self._now, now)
        made_room, self._made_room = self._made_room, []
        return made_room + self._run_out(now)

    def due(self) -> float:
        """The moment before which ``expire`` finds nothing to let go of."""
        if self._made_room:
            return float("-inf")
        return self._heap[0][0] if self._heap else float("inf")

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
        """Every record held, tombstones included, in the order in which their slots came."""
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

    def _run_out(self, now: float) -> list[Record]:
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
