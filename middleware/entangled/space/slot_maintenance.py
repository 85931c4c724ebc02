"""Maintenance of a node's records in a tuple space: notes of taken tuples, and reuse of their slots.

Safety does not depend on the notes, because the council of a tuple knows its taker.  A note only prevents other nodes
from trying to take a tuple that is already taken.
"""

from __future__ import annotations

import random
from dataclasses import dataclass, field

from middleware.entangled.background import Background
from middleware.entangled.record import Record
from middleware.entangled.space.node_interface import NodeInterface
from middleware.entangled.space.template import Tuple
from middleware.entangled.space.tuple_record import (
    MARK_BYTES,
    Member,
    StoredTuple,
    TakenNote,
    TupleId,
    pack_taken,
    pack_tuple,
    parse_record,
    parse_records,
)

GRACE_S = 2.0
"""Seconds within which a taker should write a note of its take; afterwards, a different node that detected the take
does."""
CLEANUP_INTERVAL_S = 30.0
EARLY_CLEANUP_S = 2.0
"""Seconds before slots are freed if their number grows quickly."""
MIN_SLOTS = 8
"""The number of used slots up to which slots are not freed early."""


@dataclass
class _Slots:
    """The node's own slots under one key: their contents, and which of them may be reused."""

    contents: dict[str, TupleId] = field(default_factory=dict)
    free: list[str] = field(default_factory=list)
    orphans: frozenset[str] = frozenset()
    cleanup_above: int = MIN_SLOTS
    is_cleanup_scheduled: bool = False


class SlotMaintenance:
    """Maintains the slots of one node in one space."""

    def __init__(self, node: NodeInterface, rng: random.Random, background: Background) -> None:
        self._node = node
        self._rng = rng
        self._background = background
        # Slot names are unique to this run, because tuples of earlier runs must not be overwritten.
        self._run_id = rng.randbytes(4).hex()
        self._slot_count = 0
        self._slots_by_key: dict[bytes, _Slots] = {}
        self._unconfirmed: dict[TupleId, bytes] = {}

    @property
    def keys(self) -> list[bytes]:
        """The keys whose slots are maintained."""
        return list(self._slots_by_key)

    def add_key(self, key: bytes) -> None:
        """Start to maintain this node's slots under ``key``."""
        if key not in self._slots_by_key:
            if not self._slots_by_key:
                self._background.every(CLEANUP_INTERVAL_S, self._clean_up_all)
            self._slots_by_key[key] = _Slots()

    async def put_tuple(self, key: bytes, fields: Tuple, council: list[Member], ttl: float | None) -> None:
        """Put a tuple, and remove it after ``ttl`` seconds if it was not taken; fails as ``NodeInterface.put`` does."""
        name = self._take_slot(key)
        tuple_id = TupleId(key, self._node.identity.public, name, self._rng.randbytes(MARK_BYTES))
        self._slots_by_key[key].contents[name] = tuple_id
        if ttl is not None:
            self._background.later(ttl, self._expire, tuple_id)
        await self._node.put(key, name, pack_tuple(tuple_id.mark, fields, council))

    async def put_taken_note(self, tuple_id: TupleId, taker: bytes) -> None:
        """Write a note that the tuple ``tuple_id`` was taken; the note hides the tuple from readers."""
        name = self._take_slot(tuple_id.key)
        self._slots_by_key[tuple_id.key].contents[name] = tuple_id
        await self._node.put(tuple_id.key, name, pack_taken(tuple_id, taker))

    def check_taken_note(self, tuple_id: TupleId, taker: bytes) -> None:
        """Check after ``GRACE_S`` seconds whether ``taker`` has noted its take; if not, write the note."""
        if not self._unconfirmed:
            self._background.later(GRACE_S, lambda: self._background.fork(self._check_unconfirmed()))
        self._unconfirmed[tuple_id] = taker

    # -- inside -----------------------------------------------------------------------------------------------------

    def _take_slot(self, key: bytes) -> str:
        """Return the name of a free own slot under ``key``."""
        self.add_key(key)
        slots = self._slots_by_key[key]
        if len(slots.contents) >= slots.cleanup_above and not slots.is_cleanup_scheduled:
            slots.is_cleanup_scheduled = True
            self._background.later(EARLY_CLEANUP_S, lambda: self._background.fork(self._clean_up_early(key)))
        if slots.free:
            return slots.free.pop()
        self._slot_count += 1
        return f"{self._run_id}/{self._slot_count:x}"

    def _expire(self, tuple_id: TupleId) -> None:
        slots = self._slots_by_key[tuple_id.key]
        if slots.contents.get(tuple_id.name) == tuple_id:
            del slots.contents[tuple_id.name]
            slots.free.append(tuple_id.name)
            self._remove(tuple_id.key, tuple_id.name)

    def _remove(self, key: bytes, name: str) -> None:
        async def removed() -> None:
            await self._node.remove(key, name)

        self._background.fork(removed())

    async def _check_unconfirmed(self) -> None:
        doubtful, self._unconfirmed = self._unconfirmed, {}
        for key in dict.fromkeys(tuple_id.key for tuple_id in doubtful):
            for item in parse_records(await self._node.get(key))[0]:
                if item.tuple_id in doubtful:
                    self._background.fork(self.put_taken_note(item.tuple_id, doubtful[item.tuple_id]))

    def _clean_up_all(self) -> None:
        for key in self._slots_by_key:
            self._background.fork(self._clean_up(key, is_thorough=True))

    async def _clean_up_early(self, key: bytes) -> None:
        try:
            await self._clean_up(key)
        finally:
            self._slots_by_key[key].is_cleanup_scheduled = False

    async def _clean_up(self, key: bytes, is_thorough: bool = False) -> None:
        """Free own slots under ``key`` that contain taken tuples, or notes about tuples that no longer exist.

        A slot is freed only after this node has read back its last write, because replicas may be late.  A note is
        freed only after its tuple was missing in two reads, because a single read may miss the tuple.  A thorough run
        also removes the records of slots that were already free in the previous run, to make reads smaller.
        """
        slots = self._slots_by_key[key]
        idle = set(slots.free)
        own = self._node.identity.public
        records: list[Record] = await self._node.get(key)
        postings = {record.slot: parse_record(record) for record in records}
        present = {item.tuple_id for item in postings.values() if isinstance(item, StoredTuple)}
        taken = {item.tuple_id for item in postings.values() if isinstance(item, TakenNote)}
        orphans = []
        for slot, item in postings.items():
            is_orphan = isinstance(item, TakenNote) and item.tuple_id not in present
            is_over = item is not None and item.tuple_id in taken and not isinstance(item, TakenNote)
            if slot.owner != own or item is None or not (is_orphan or is_over):
                continue
            name = slot.name
            if is_orphan:
                orphans.append(name)
            if is_orphan and name not in slots.orphans:
                continue
            if slots.contents.get(name) == item.tuple_id:
                del slots.contents[name]
                slots.free.append(name)
            elif not name.startswith(self._run_id) or (is_thorough and name in idle and name in slots.free):
                self._remove(key, name)
        slots.orphans = frozenset(orphans)
        slots.cleanup_above = 2 * len(slots.contents) + MIN_SLOTS
