"""Keepsake: copies of watched records in the node's own store, for whoever reads the store's file.

A copy is no replica's opinion: nobody is answered or pushed from it, no lease counts for it, and it goes when the watch
no longer shows its record.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable

from middleware.entangled.data.store import Store
from middleware.entangled.errors import NotRunning, Refused
from middleware.entangled.record import MAX_TTL, Record, Slot


class Keepsakes:
    """The copies that a node keeps in ``store`` beside what it holds as a replica."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._kept: dict[bytes, dict[Slot, Record]] = {}

    def __contains__(self, slot: Slot) -> bool:
        """Whether what the store has in ``slot`` is a copy only."""
        return slot in self._kept.get(slot.key, {})

    def under(self, key: bytes) -> Collection[Slot]:
        """The slots under ``key`` of which there is a copy only."""
        return self._kept.get(key, {})

    def keep(self, key: bytes, records: Iterable[Record], now: float) -> None:
        """Make the copies under ``key`` those of ``records`` that the store does not hold anyway."""
        kept = self._kept.setdefault(key, {})
        wanted = {record.slot: record for record in records}
        for slot in [slot for slot, copy in kept.items() if wanted.get(slot) != copy]:
            self.release(slot)
        for slot, record in wanted.items():
            if self._store.slot(slot) is None:
                try:
                    self._store.put(record, now + MAX_TTL)
                except Refused:
                    continue  # no room for copies; what is held for others comes first
                kept[slot] = record
        if not kept:
            del self._kept[key]

    def release(self, slot: Slot) -> None:
        """Let go of the copy in ``slot``, if there is one: it is not shown any more, or comes to be held."""
        if self._kept.get(slot.key, {}).pop(slot, None) is not None:
            self._store.discard(slot)

    def clear(self) -> None:
        """Let go of every copy; a store that is closed already keeps what it has."""
        try:
            for kept in list(self._kept.values()):
                for slot in list(kept):
                    self.release(slot)
        except NotRunning:
            pass
        self._kept.clear()
