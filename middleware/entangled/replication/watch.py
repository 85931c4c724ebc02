"""The view of one watched key, merged from its replicas.

``View`` merges the reports of several replicas, without I/O.  A slot is present as long as any valid report contains
it.  If reports contain different records of one slot, the record that supersedes the others is used.  A report of a
node may contain leased records that this node itself owns.  All other nodes ignore these, because they would remain
after a failure of the node.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable

from middleware.entangled.identity import derive_node_id
from middleware.entangled.record import Record, Slot

OnChanged = Callable[[list[Record]], None]


_EMPTY_DIGEST = hashlib.blake2s(digest_size=8).digest()


def digest_of(records: Iterable[Record]) -> bytes:
    """Return an 8-byte digest of ``records``, independent of their order."""
    records = list(records)
    if not records:
        return _EMPTY_DIGEST
    h = hashlib.blake2s(digest_size=8)
    for record in sorted(records, key=lambda r: (r.key, r.owner, r.name)):
        place = record.owner + record.name.encode() + b"\0"
        h.update(place + record.sequence.to_bytes(8, "big") + record.signature[:8])
    return h.digest()


class View:
    """The reports of all replicas of one key, merged for the node ``own_id``."""

    def __init__(self, own_id: bytes = b"") -> None:
        self._own_id = own_id
        self._reports: dict[bytes, dict[Slot, Record]] = {}

    def replace(self, replica: bytes, records: Iterable[Record]) -> None:
        """Set the report of ``replica`` (a node id) to ``records``, tombstones included."""
        self._reports[replica] = {r.slot: r for r in records}

    def add(self, replica: bytes, record: Record) -> None:
        """Add ``record`` to the report of ``replica``."""
        held = self._reports.setdefault(replica, {})
        if record.supersedes(held.get(record.slot)):
            held[record.slot] = record

    def remove(self, replica: bytes, slot: Slot) -> None:
        """Remove the record of ``slot``, which expired at ``replica``, from the report of this replica."""
        self._reports.get(replica, {}).pop(slot, None)

    def retain(self, is_lawful: Callable[[Slot], bool]) -> None:
        """Drop all records in slots for which ``is_lawful`` returns False."""
        for replica, held in self._reports.items():
            self._reports[replica] = {slot: record for slot, record in held.items() if is_lawful(slot)}

    def forget(self, replica: bytes) -> None:
        """Discard the report of ``replica``."""
        self._reports.pop(replica, None)

    def replicas(self) -> list[bytes]:
        """Return the node ids with a report, in order of arrival."""
        return list(self._reports)

    def digest(self, replica: bytes) -> bytes:
        """Return the digest of the report of ``replica``."""
        return digest_of(self._reports.get(replica, {}).values())

    def merge(self) -> list[Record]:
        """Return the merged records, without tombstones, in the order of (owner, name)."""
        best: dict[Slot, Record] = {}
        for replica, held in self._reports.items():
            for slot, record in held.items():
                is_own_lease = record.lifetime == "leased" and derive_node_id(record.owner) == replica
                if is_own_lease and replica != self._own_id:
                    continue
                if record.supersedes(best.get(slot)):
                    best[slot] = record
        live = [record for record in best.values() if not record.is_tombstone]
        return sorted(live, key=lambda r: (r.owner, r.name))


class Watch:
    """One subscription to one key; ``records`` are the currently known records.

    ``requested`` contains the node ids of the replicas to which a request to push was sent; pushes of other nodes are
    ignored.  ``has_copies``: the records are also stored in the node's own store.  ``push_numbers`` maps replicas to
    the number of their last push.  ``due_at`` is the time of the next renewal in a large network.  ``on_stop`` is
    called when the subscription ends.
    """

    def __init__(
        self,
        key: bytes,
        on_changed: OnChanged,
        on_stop: Callable[[Watch], None],
        own_id: bytes = b"",
        has_copies: bool = False,
    ) -> None:
        self.key = key
        self.view = View(own_id)
        self.records: list[Record] = []
        self.requested: set[bytes] = set()
        self.push_numbers: dict[bytes, int] = {}
        self.due_at = 0.0
        self.has_copies = has_copies
        self._on_changed = on_changed
        self._on_stop = on_stop

    def update(self) -> None:
        """Merge the view, and notify the subscriber if the records changed."""
        records = self.view.merge()
        if records != self.records:
            self.records = records
            self._on_changed(list(records))

    def forget(self, replica: bytes) -> None:
        """Discard the report of ``replica`` and ignore its pushes until the next request to it."""
        self.requested.discard(replica)
        self.push_numbers.pop(replica, None)
        self.view.forget(replica)

    def stop(self) -> None:
        """End the subscription without further notifications."""
        self._on_changed = lambda _records: None
        self._on_stop(self)
