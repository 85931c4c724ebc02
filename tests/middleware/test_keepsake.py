"""Tests of the copies that a node keeps for whoever reads its store."""

from __future__ import annotations

from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.data.memory import MemoryStore
from middleware.entangled.errors import NotRunning
from middleware.entangled.identity import Identity
from middleware.entangled.record import Record, Slot, hashed_key
from middleware.entangled.replication.keepsake import Keepsakes

DOG = Identity(b"\1" * 32)
KEY = hashed_key("devices")


def record(name: str, sequence: int = 1) -> Record:
    """A lease; nobody looks at its signature here."""
    return Record(KEY, name, DOG.public, sequence, "leased", 1.0, b"v", bytes(64))


class ClosedStore(MemoryStore):
    """A store that its owner has closed already."""

    def discard(self, slot: Slot) -> bool:
        raise NotRunning("closed")


class KeepsakeTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.store = MemoryStore(3)
        self.copies = Keepsakes(self.store)

    def test_what_is_held_is_left_alone(self) -> None:
        """A slot that the node holds as a replica is neither copied nor let go of."""
        self.store.put(record("a"), 5.0)
        self.copies.keep(KEY, [record("a", 2)], 0.0)
        self.copies.keep(KEY, [], 0.0)
        self.copies.release(record("a").slot)
        self.assertEqual(self.store.get(KEY), [record("a")])
        self.assertEqual(self.store.expire(5.0), [record("a")])

    def test_full_store(self) -> None:
        """Where there is no room for copies there are fewer; what is held for others stays."""
        self.store.put(record("z"), 5.0)
        self.copies.keep(KEY, [record(name) for name in "abc"], 0.0)
        self.assertEqual([r.name for r in self.store.get(KEY)], ["a", "b", "z"])
        self.copies.clear()
        self.assertEqual([r.name for r in self.store.get(KEY)], ["z"])

    def test_closed_store(self) -> None:
        """A store that is closed already does not stand in the way of a stop."""
        copies = Keepsakes(ClosedStore())
        copies.keep(KEY, [record("a")], 0.0)
        copies.clear()
        self.assertNotIn(record("a").slot, copies)
