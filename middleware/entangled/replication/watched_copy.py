"""Copies of watched records in the node's own store, for programs that read the store's file.

A watched copy is not a replica: it is neither returned nor pushed to peers, extends no lease, and is removed when the
watch drops its record.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable

from middleware.entangled.data.store import Store
from middleware.entangled.errors import NotRunning, Refused
from middleware.entangled.record import MAX_TTL_S, Record, Slot


class WatchedCopies:
    """The watched copies in ``store``, as distinct from records that the node stores as a replica."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._copies: dict[bytes, dict[Slot, Record]] = {}

    def __contains__(self, slot: Slot) -> bool:
        """Return whether the store has only a copy in ``slot``."""
        return slot in self._copies.get(slot.key, {})

    def slots_of(self, key: bytes) -> Collection[Slot]:
        """Return the slots under ``key`` with a copy."""
        return self._copies.get(key, {})

    def replace(self, key: bytes, records: Iterable[Record], now: float) -> None:
        """Set the copies under ``key`` to ``records``, except records that the node stores as a replica."""
        copies = self._copies.setdefault(key, {})
        wanted = {record.slot: record for record in records}
        for slot in [slot for slot, copy in copies.items() if wanted.get(slot) != copy]:
            self.remove(slot)
        for slot, record in wanted.items():
            if self._store.get_slot(slot) is None:
                try:
                    self._store.put(record, now + MAX_TTL_S)
                except Refused:
                    continue  # the store is full: replicas take precedence over copies
                copies[slot] = record
        if not copies:
            del self._copies[key]

    def remove(self, slot: Slot) -> None:
        """Remove the copy in ``slot``, if there is one."""
        if self._copies.get(slot.key, {}).pop(slot, None) is not None:
            self._store.discard(slot)

    def clear(self) -> None:
        """Remove all copies, unless the store is closed already."""
        try:
            for copies in list(self._copies.values()):
                for slot in list(copies):
                    self.remove(slot)
        except NotRunning:
            pass
        self._copies.clear()
