"""Maintain a routing table with many near and few distant contacts (Kademlia, sections 2.2 and 2.4).

The table is the tree of the paper: each bucket covers a range of ids, and the first bucket covers all ids.  A full
bucket is split if it covers the node's own id, or if the new contact is among the k closest to the node.  Therefore the
node knows its whole neighbourhood even in an unbalanced tree (section 2.4).

In any other full bucket a contact that continues to answer is never replaced; the new contact waits in the bucket's
replacement cache.  The reasons are that nodes with a long uptime are likely to stay up, and that an attacker must not
be able to flush the table with invented ids.
"""

from __future__ import annotations

import random
from bisect import bisect_right
from dataclasses import dataclass, field

from middleware.entangled.bounded import put_bounded
from middleware.entangled.contact import Contact
from middleware.entangled.identity import ID_BYTES
from middleware.entangled.kademlia.distance import bucket_index, select_closest

STALE_AFTER = 3
"""The number of successive misses that make a contact stale; any new contact may replace a stale contact."""
DROPPED_AFTER = 5
"""The number of successive misses after which a contact is deleted even if there is no replacement."""
PING_INTERVAL_S = 1.0
"""After a contact answered or was returned for a ping, it is not returned for a ping for this number of seconds."""


@dataclass(slots=True)
class _Entry:
    """A contact in its bucket with its state."""

    contact: Contact
    seen_at: float
    pinged_at: float
    misses: int = 0

    @property
    def is_stale(self) -> bool:
        return self.misses >= STALE_AFTER


@dataclass(slots=True)
class _Bucket:
    """One k-bucket of the ids from ``low`` to below ``high``; both dicts begin with the least recently seen contact."""

    low: int
    high: int
    entries: dict[bytes, _Entry] = field(default_factory=dict)
    replacements: dict[bytes, Contact] = field(default_factory=dict)


class RoutingTable:
    """The contacts of the node ``own_id``, at most ``k`` in each bucket.

    A larger ``k`` means more replicas, more contacts to probe, and lookups that tolerate more simultaneous failures.
    Times (``now``) are seconds of one clock.  ``version`` changes whenever a contact is added, deleted or moved.
    """

    def __init__(self, own_id: bytes, k: int = 8) -> None:
        self._own_id = own_id
        self._k = k
        self._own = int.from_bytes(own_id)
        self._buckets = [_Bucket(0, 1 << (8 * ID_BYTES))]
        self._size = 0
        self.version = 0
        self._lows = [0]
        self._searched_at: dict[int, float] = {}
        self._nearest_distances: list[int] = []
        self._nearest_version = -1

    def __len__(self) -> int:
        return self._size

    def get(self, node_id: bytes) -> Contact | None:
        """Return the contact with this id, if it is in the table (not in a replacement cache)."""
        bucket = self._bucket(node_id)
        entry = bucket.entries.get(node_id) if bucket else None
        return entry.contact if entry else None

    def list_contacts(self) -> list[Contact]:
        """Return all contacts: the nearest bucket first, and within a bucket the least recently seen contact first."""
        nearest_first = sorted(self._buckets, key=lambda bucket: bucket.low ^ self._own & -(bucket.high - bucket.low))
        return [entry.contact for bucket in nearest_first for entry in bucket.entries.values()]

    def closest(self, target: bytes, count: int | None = None) -> list[Contact]:
        """Return the ``count`` (default k) contacts closest to ``target``, closest first.

        Stale contacts are used only if there are not enough other contacts.  With stale contacts, a node can recover
        from a radio failure, in which all contacts become stale at the same time.
        """
        wanted, goal = self._k if count is None else count, int.from_bytes(target)
        stale: list[Contact] = []
        chosen: list[Contact] = []
        # All contacts in a bucket nearer to the target are nearer than all contacts in a more distant bucket.
        for bucket in sorted(self._buckets, key=lambda bucket: (bucket.low ^ goal) & -(bucket.high - bucket.low)):
            live: list[Contact] = []
            for entry in bucket.entries.values():
                (stale if entry.misses >= STALE_AFTER else live).append(entry.contact)
            chosen += select_closest(live, target, wanted - len(chosen))
            if len(chosen) == wanted:
                return chosen
        if stale:
            chosen = select_closest([*chosen, *select_closest(stale, target, wanted - len(chosen))], target, wanted)
        return chosen

    def record_contact(self, contact: Contact, now: float) -> Contact | None:
        """Record that ``contact`` has proved its key and its address.

        Returns the least recently seen contact of a full bucket: the caller pings the returned contact; if it does not
        answer (``record_miss``), the new contact replaces it.  A known contact at a new address has moved there.
        """
        if contact.node_id == self._own_id:
            return None
        bucket = self._find_bucket(contact.node_id)
        entry = bucket.entries.pop(contact.node_id, None)
        if entry is not None:
            bucket.entries[contact.node_id] = entry  # the most recently seen contact is last
            if entry.contact != contact:  # otherwise keep the existing object, which is shared
                entry.contact = contact
                self.version += 1
            entry.seen_at = entry.pinged_at = now
            entry.misses = 0
            return None
        self._searched_at.setdefault(bucket_index(self._own_id, contact.node_id), now)
        while len(bucket.entries) >= self._k and self._may_split(bucket, contact.node_id):
            self._split(bucket)
            bucket = self._find_bucket(contact.node_id)
        if len(bucket.entries) >= self._k:
            stale = next((node_id for node_id, entry in bucket.entries.items() if entry.is_stale), None)
            if stale is None:
                return self._cache(bucket, contact, now)
            del bucket.entries[stale]
            self._size -= 1
        bucket.replacements.pop(contact.node_id, None)
        bucket.entries[contact.node_id] = _Entry(contact, now, now)
        self._size += 1
        self.version += 1
        return None

    def has_room(self, node_id: bytes) -> bool:
        """Return whether a contact with this id is in its bucket or would be added to it."""
        bucket = self._bucket(node_id)
        if bucket is None:
            return False
        entries = bucket.entries
        if len(entries) < self._k or node_id in entries or any(entry.is_stale for entry in entries.values()):
            return True
        return self._may_split(bucket, node_id)

    def record_miss(self, contact: Contact, now: float) -> None:
        """Record that ``contact`` did not answer at its address.

        After ``STALE_AFTER`` successive misses the most recently seen waiting contact replaces ``contact``.  If no
        contact waits, ``contact`` stays in the table as a stale contact until ``DROPPED_AFTER`` misses.  A miss at an
        old address of a contact that has moved is ignored.
        """
        bucket = self._bucket(contact.node_id)
        if bucket is None:
            return
        if bucket.replacements.get(contact.node_id) == contact:
            del bucket.replacements[contact.node_id]
        entry = bucket.entries.get(contact.node_id)
        if entry is None or entry.contact != contact:
            return
        entry.misses += 1
        if entry.misses >= DROPPED_AFTER or (entry.is_stale and bucket.replacements):
            self._remove_entry(bucket, contact.node_id, now)

    def remove(self, contact: Contact, now: float = 0.0) -> None:
        """Delete ``contact``, which left the network; a waiting contact replaces it."""
        bucket = self._bucket(contact.node_id)
        if bucket is not None:
            bucket.replacements.pop(contact.node_id, None)
            if contact.node_id in bucket.entries:
                self._remove_entry(bucket, contact.node_id, now)

    def record_lookup(self, target: bytes, now: float) -> None:
        """Record a lookup for ``target``, which refreshes its range."""
        if target != self._own_id:
            self._searched_at[bucket_index(self._own_id, target)] = now

    def find_stale(self, now: float, older_than: float) -> list[int]:
        """Return the indices of the ranges without a lookup for ``older_than`` seconds.

        The range with the index i contains the distances from 2**i to below 2**(i+1).  Only ranges from the nearest
        range with a contact to the most distant range are returned, because nearer ranges are empty (Kademlia, section
        2.3).
        """
        filled = [bucket_index(self._own_id, contact.node_id) for contact in self.list_contacts()]
        if not filled:
            return []
        before = now - older_than
        return [i for i in range(min(filled), 8 * ID_BYTES) if self._searched_at.get(i, before) <= before]

    def refresh_target(self, index: int, rng: random.Random) -> bytes:
        """Return a random id in the range of bucket ``index``; a lookup for it refreshes the bucket."""
        apart = (1 << index) | rng.getrandbits(index)
        return (int.from_bytes(self._own_id) ^ apart).to_bytes(ID_BYTES)

    def _bucket(self, node_id: bytes) -> _Bucket | None:
        return None if node_id == self._own_id else self._find_bucket(node_id)

    def _find_bucket(self, node_id: bytes) -> _Bucket:
        number = int.from_bytes(node_id)
        return self._buckets[bisect_right(self._lows, number) - 1]

    def _may_split(self, bucket: _Bucket, contact: bytes) -> bool:
        if bucket.high - bucket.low == 1:
            return False
        if bucket.low <= self._own < bucket.high:
            return True
        apart = int.from_bytes(contact) ^ self._own
        return len(self._nearest()) < self._k or apart < self._nearest()[-1]

    def _nearest(self) -> list[int]:
        """Return the distances of the k contacts closest to this node, in ascending order."""
        if self._nearest_version != self.version:
            self._nearest_version = self.version
            own = self._own
            apart = [int.from_bytes(node_id) ^ own for bucket in self._buckets for node_id in bucket.entries]
            self._nearest_distances = sorted(apart)[: self._k]
        return self._nearest_distances

    def _split(self, bucket: _Bucket) -> None:
        """Replace ``bucket`` by two buckets of half the range each."""
        middle = (bucket.low + bucket.high) // 2
        halves = [_Bucket(bucket.low, middle), _Bucket(middle, bucket.high)]
        for node_id, entry in bucket.entries.items():
            halves[int.from_bytes(node_id) >= middle].entries[node_id] = entry
        for node_id, contact in bucket.replacements.items():
            halves[int.from_bytes(node_id) >= middle].replacements[node_id] = contact
        position = self._buckets.index(bucket)
        self._buckets[position : position + 1] = halves
        self._lows = [each.low for each in self._buckets]

    def _remove_entry(self, bucket: _Bucket, node_id: bytes, now: float) -> None:
        """Delete a contact; the most recently seen waiting contact replaces it."""
        del bucket.entries[node_id]
        self._size -= 1
        self.version += 1
        if bucket.replacements:
            contact_id, contact = bucket.replacements.popitem()
            bucket.entries[contact_id] = _Entry(contact, now, now)
            self._size += 1

    def _cache(self, bucket: _Bucket, contact: Contact, now: float) -> Contact | None:
        """Add ``contact`` to the replacement cache, and return the contact to ping."""
        put_bounded(bucket.replacements, contact.node_id, contact, self._k)
        oldest = next(iter(bucket.entries.values()))
        # Many new contacts must not cause many pings to one old contact.
        if now - max(oldest.seen_at, oldest.pinged_at) < PING_INTERVAL_S:
            return None
        oldest.pinged_at = now
        return oldest.contact
