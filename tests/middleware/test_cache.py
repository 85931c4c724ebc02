"""Tests of the copies that a node caches in addition to its records, on lookup paths and for its watches."""

from __future__ import annotations

from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.data.memory import MemoryStore
from middleware.entangled.errors import NotRunning
from middleware.entangled.identity import Identity
from middleware.entangled.record import Record, Slot, hash_key
from middleware.entangled.replication.cache import MAX_AGE_S, MAX_BYTES, MAX_KEYS, PathCache
from middleware.entangled.replication.watched_copy import WatchedCopies


def copied(key: bytes, size: int = 1) -> list[Record]:
    """Return one record of ``key``, with an invalid signature because the cache does not verify signatures."""
    return [Record(key, "a", bytes(32), 1, "team", 60.0, bytes(size), bytes(64))]


class PathCacheTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.cache = PathCache()
        self.key = hash_key("a")

    def test_a_copy_runs_out(self) -> None:
        """A copy expires after its TTL, which is at most ``MAX_AGE_S``."""
        for ttl, lives in ((5.0, 5.0), (1e9, MAX_AGE_S)):
            self.cache.put(self.key, copied(self.key), ttl, 0.0)
            self.assertEqual(self.cache.get(self.key, lives - 0.1), copied(self.key))
            self.assertIsNone(self.cache.get(self.key, lives))

    def test_what_is_not_kept(self) -> None:
        """A copy that is too large, or has no positive finite TTL, is not stored; the previous copy is removed."""
        for ttl, size in ((0.0, 1), (-1.0, 1), (float("nan"), 1), (9.0, MAX_BYTES)):
            self.cache.put(self.key, copied(self.key), 9.0, 0.0)
            self.cache.put(self.key, copied(self.key, size), ttl, 0.0)
            self.assertIsNone(self.cache.get(self.key, 0.0))

    def test_keys_are_bounded(self) -> None:
        """The number of keys is bounded; the least recently read key is evicted first."""
        keys = [hash_key(str(number)) for number in range(MAX_KEYS + 1)]
        for key in keys[:-1]:
            self.cache.put(key, copied(key), 9.0, 0.0)
        self.cache.get(keys[0], 0.0)
        self.cache.put(keys[-1], copied(keys[-1]), 9.0, 0.0)
        self.assertEqual(self.held(keys[:3]), [0, 2])

    def test_bytes_are_counted(self) -> None:
        """The cache is limited in bytes: it evicts the least recently read copy, and a removed copy frees its bytes."""
        half = MAX_BYTES // 2 - copied(self.key, 0)[0].message_bytes
        keys = [hash_key(str(number)) for number in range(4)]
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
        """Read each of these keys in order; return the numbers of the keys that are cached."""
        return [number for number, key in enumerate(keys) if self.cache.get(key, 0.0) is not None]


DOG = Identity(b"\1" * 32)
KEY = hash_key("devices")


def record(name: str, sequence: int = 1) -> Record:
    """Return a leased record with an unchecked signature."""
    return Record(KEY, name, DOG.public, sequence, "leased", 1.0, b"v", bytes(64))


class ClosedStore(MemoryStore):
    """A store that is already closed."""

    def discard(self, slot: Slot) -> bool:
        raise NotRunning("closed")


class WatchedCopiesTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.store = MemoryStore(3)
        self.copies = WatchedCopies(self.store)

    def test_what_is_held_is_left_alone(self) -> None:
        """If the node stores a slot as a replica, the cache neither copies nor releases this slot."""
        self.store.put(record("a"), 5.0)
        self.copies.replace(KEY, [record("a", 2)], 0.0)
        self.copies.replace(KEY, [], 0.0)
        self.copies.remove(record("a").slot)
        self.assertEqual(self.store.get(KEY), [record("a")])
        self.assertEqual(self.store.expire(5.0), [record("a")])

    def test_full_store(self) -> None:
        """In a full store the number of copies is limited, and the records of a replica are kept."""
        self.store.put(record("z"), 5.0)
        self.copies.replace(KEY, [record(name) for name in "abc"], 0.0)
        self.assertEqual([r.name for r in self.store.get(KEY)], ["a", "b", "z"])
        self.copies.clear()
        self.assertEqual([r.name for r in self.store.get(KEY)], ["z"])

    def test_closed_store(self) -> None:
        """A closed store raises no error when the copies are cleared."""
        copies = WatchedCopies(ClosedStore())
        copies.replace(KEY, [record("a")], 0.0)
        copies.clear()
        self.assertNotIn(record("a").slot, copies)
