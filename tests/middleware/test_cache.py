"""Tests of copies on the path; pure."""

from __future__ import annotations

from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.record import Record, hashed_key
from middleware.entangled.replication.cache import MAX_AGE, MAX_BYTES, MAX_KEYS, PathCache


def copied(key: bytes, size: int = 1) -> list[Record]:
    """One record of ``key``; copies do not look at signatures."""
    return [Record(key, "a", bytes(32), 1, "team", 60.0, bytes(size), bytes(64))]


class PathCacheTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.cache = PathCache()
        self.key = hashed_key("a")

    def test_a_copy_runs_out(self) -> None:
        """A copy is there for its time, at most for the longest that any may have."""
        for ttl, lives in ((5.0, 5.0), (1e9, MAX_AGE)):
            self.cache.put(self.key, copied(self.key), ttl, 0.0)
            self.assertEqual(self.cache.get(self.key, lives - 0.1), copied(self.key))
            self.assertIsNone(self.cache.get(self.key, lives))

    def test_what_is_not_kept(self) -> None:
        """A copy that has no time left, or none that is a number, or is too large, is not kept, nor the one before."""
        for ttl, size in ((0.0, 1), (-1.0, 1), (float("nan"), 1), (9.0, MAX_BYTES)):
            self.cache.put(self.key, copied(self.key), 9.0, 0.0)
            self.cache.put(self.key, copied(self.key, size), ttl, 0.0)
            self.assertIsNone(self.cache.get(self.key, 0.0))

    def test_keys_are_bounded(self) -> None:
        """There is an end to keys, and what was not read for longest goes first."""
        keys = [hashed_key(str(number)) for number in range(MAX_KEYS + 1)]
        for key in keys[:-1]:
            self.cache.put(key, copied(key), 9.0, 0.0)
        self.cache.get(keys[0], 0.0)
        self.cache.put(keys[-1], copied(keys[-1]), 9.0, 0.0)
        self.assertEqual(self.held(keys[:3]), [0, 2])

    def test_bytes_are_counted(self) -> None:
        """Copies fill the cache to the byte; beyond, the least recently read one goes, and what goes frees its room."""
        half = MAX_BYTES // 2 - copied(self.key, 0)[0].message_bytes
        keys = [hashed_key(str(number)) for number in range(4)]
        for key in (keys[0], keys[1], keys[1]):
            self.cache.put(key, copied(key, half), 9.0, 0.0)
        self.assertEqual(self.held(keys), [0, 1])
        self.cache.get(keys[0], 0.0)
        self.cache.put(keys[2], copied(keys[2], half), 9.0, 0.0)
        self.assertEqual(self.held(keys), [0, 2])
        self.cache.drop(keys[0])
        self.cache.drop(keys[0])
        self.cache.put(keys[3], copied(keys[3], half), 9.0, 0.0)
        self.assertEqual(self.held(keys), [2, 3])
        self.cache.get(keys[2], 9.0)
        self.cache.get(keys[3], 9.0)
        self.cache.put(self.key, copied(self.key, 2 * half), 9.0, 9.0)
        self.assertIsNotNone(self.cache.get(self.key, 9.0))

    def held(self, keys: list[bytes]) -> list[int]:
        """Which of ``keys`` have a copy, by number; each of these is then read, in that order."""
        return [number for number, key in enumerate(keys) if self.cache.get(key, 0.0) is not None]
