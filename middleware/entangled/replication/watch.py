"""Watch: what is known of one key, kept up to date by those who hold it.

``View`` merges what several replicas say; it is pure.  A slot is present while any replica that still counts says so;
of several records of one slot the one that beats the others holds.  No node testifies for its own lease, except to
itself: when a node dies, what it said of itself would otherwise outlive it.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable

from middleware.entangled.identity import node_id
from middleware.entangled.record import Record, Slot

Changed = Callable[[list[Record]], None]


_OF_NOTHING = hashlib.blake2s(digest_size=8).digest()


def digest_of(records: Iterable[Record]) -> bytes:
    """Eight bytes that tell whether two replicas hold the same of a key."""
    records = list(records)
    if not records:
        return _OF_NOTHING
    h = hashlib.blake2s(digest_size=8)
    for record in sorted(records, key=lambda r: (r.key, r.owner, r.name)):
        place = record.owner + record.name.encode() + b"\0"
        h.update(place + record.sequence.to_bytes(8, "big") + record.signature[:8])
    return h.digest()


class View:
    """The opinions of all replicas of one key, merged for the node ``own_id``."""

    def __init__(self, own_id: bytes = b"") -> None:
        self._own_id = own_id
        self._opinions: dict[bytes, dict[Slot, Record]] = {}

    def replace(self, replica: bytes, records: Iterable[Record]) -> None:
        """``replica`` (a node id) holds exactly ``records``, tombstones included."""
        self._opinions[replica] = {r.slot: r for r in records}

    def add(self, replica: bytes, record: Record) -> None:
        """``replica`` now holds ``record``."""
        held = self._opinions.setdefault(replica, {})
        if record.beats(held.get(record.slot)):
            held[record.slot] = record

    def remove(self, replica: bytes, slot: Slot) -> None:
        """``replica`` no longer holds the record of ``slot``: its lease or its time is over there."""
        self._opinions.get(replica, {}).pop(slot, None)

    def retain(self, is_lawful: Callable[[Slot], bool]) -> None:
        """Forget the records in those slots of which ``is_lawful`` does not hold, whichever replica has them."""
        for replica, held in self._opinions.items():
            self._opinions[replica] = {slot: record for slot, record in held.items() if is_lawful(slot)}

    def forget(self, replica: bytes) -> None:
        """``replica`` is gone; what it said does not count any more."""
        self._opinions.pop(replica, None)

    def replicas(self) -> list[bytes]:
        """The node ids whose opinions count, in the order in which they came."""
        return list(self._opinions)

    def digest(self, replica: bytes) -> bytes:
        """The digest of what ``replica`` is believed to hold."""
        return digest_of(self._opinions.get(replica, {}).values())

    def merged(self) -> list[Record]:
        """What the key holds, without tombstones, in the order of (owner, name)."""
        best: dict[Slot, Record] = {}
        for replica, held in self._opinions.items():
            for slot, record in held.items():
                is_own_lease = record.lifetime == "leased" and node_id(record.owner) == replica
                if is_own_lease and replica != self._own_id:
                    continue
                if record.beats(best.get(slot)):
                    best[slot] = record
        live = [record for record in best.values() if not record.is_tombstone]
        return sorted(live, key=lambda r: (r.owner, r.name))


class Watch:
    """One subscription to one key; ``records`` is what is known now.

    ``asked`` are the node ids of the replicas that were asked to push; nobody else is believed.  ``keep`` says whether
    what is known is to be kept in the node's own store as well.  ``pushed`` is the number of each replica's last push,
    ``due_at`` when the replicas of a large network are asked again.  ``unwatch`` is called at the end.
    """

    def __init__(
        self,
        key: bytes,
        changed: Changed,
        unwatch: Callable[[Watch], None],
        own_id: bytes = b"",
        keep: bool = False,
    ) -> None:
        self.key = key
        self.view = View(own_id)
        self.records: list[Record] = []
        self.asked: set[bytes] = set()
        self.pushed: dict[bytes, int] = {}
        self.due_at = 0.0
        self.keep = keep
        self._changed = changed
        self._unwatch = unwatch

    def settle(self) -> None:
        """Merge the view again and tell the subscriber, if anything is different from what it knows."""
        records = self.view.merged()
        if records != self.records:
            self.records = records
            self._changed(list(records))

    def forget(self, replica: bytes) -> None:
        """What ``replica`` says does not count until it is asked again."""
        self.asked.discard(replica)
        self.pushed.pop(replica, None)
        self.view.forget(replica)

    def stop(self) -> None:
        """End the subscription; nothing is told any more."""
        self._changed = lambda _records: None
        self._unwatch(self)
