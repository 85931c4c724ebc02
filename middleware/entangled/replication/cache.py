"""Cached copies of popular records on the lookup path to their replicas (Kademlia, section 2.3).

A cached copy is not a replica: it is not counted in majorities, is never handed over, is stored only in memory, and is
evicted first.
"""

from __future__ import annotations

from middleware.entangled.record import Record

MAX_KEYS = 256
MAX_BYTES = 256 * 1024
MAX_AGE_S = 60.0
"""The maximum age in seconds of a copy at the node that follows the closest ones.  For each further node in between,
the maximum age is halved."""


class PathCache:
    """The cached copies of one node; the least recently read key is evicted first.

    There are at most ``MAX_KEYS`` keys and ``MAX_BYTES`` bytes.
    """

    def __init__(self) -> None:
        self._copies: dict[bytes, tuple[float, int, list[Record]]] = {}
        self._bytes = 0

    def put(self, key: bytes, records: list[Record], ttl: float, now: float) -> None:
        """Cache ``records`` for ``ttl`` seconds, at most ``MAX_AGE_S``."""
        size = sum(record.message_bytes for record in records)
        self.drop(key)
        if size > MAX_BYTES or not ttl > 0.0:
            return
        self._copies[key] = (now + min(ttl, MAX_AGE_S), size, records)
        self._bytes += size
        while self._bytes > MAX_BYTES or len(self._copies) > MAX_KEYS:
            self.drop(next(iter(self._copies)))

    def get(self, key: bytes, now: float) -> list[Record] | None:
        """Return the copy under ``key``, or None."""
        copy = self._copies.get(key)
        if copy is None:
            return None
        if copy[0] <= now:
            self.drop(key)
            return None
        self._copies[key] = self._copies.pop(key)
        return copy[2]

    def drop(self, key: bytes) -> None:
        """Remove the copy under ``key``, if there is one."""
        copy = self._copies.pop(key, None)
        if copy is not None:
            self._bytes -= copy[1]
