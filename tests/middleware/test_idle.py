"""Tests that an idle node does no periodic work for empty tables."""

from __future__ import annotations

from middleware.entangled.data.memory import MemoryStore
from middleware.entangled.identity import Identity
from middleware.entangled.record import Record, hash_key
from middleware.entangled.replication.replica import MAX_SWEEP_INTERVAL_S, SWEEP_INTERVAL_S
from tests.fleet import EntangledTeam, FleetCase

KEY = hash_key("a")
OWNER = Identity(bytes([7]) * 32)


def record(name: str, ttl: float) -> Record:
    """Return a record with this TTL in seconds."""
    return Record(KEY, name, OWNER.public, 1, "team", ttl, b"x").sign(OWNER)


class IdleTests(FleetCase):
    def looks(self, fleet: EntangledTeam) -> list[float]:
        """Return a list that will contain the time of each later expiry sweep of the first node."""
        moments: list[float] = []
        store = fleet.nodes[0].store
        expire = store.expire

        def looked(now: float) -> list[Record]:
            moments.append(now)
            return expire(now)

        self.patch(store, "expire", looked)
        return moments

    def test_an_empty_store_is_not_swept(self) -> None:
        """An empty store is not swept; stored records expire on time, and each sweep is at a multiple of 0.1 s."""
        fleet = self.fleet(1)
        node, moments = fleet.nodes[0], self.looks(fleet)
        fleet.run(10.0)
        self.assertEqual(moments, [])
        began = fleet.clock.seconds()
        node.replica.store_locally(record("long", 5.0))
        node.replica.store_locally(record("short", 0.25))
        fleet.run(0.25 + SWEEP_INTERVAL_S)
        self.assertEqual([r.name for r in node.store.records()], ["long"])
        fleet.run(4.0)
        self.assertEqual(len(moments), 1)
        fleet.run(1.0)
        self.assertEqual(len(node.store), 0)
        self.assertLessEqual(moments[-1] - began, 5.0 + SWEEP_INTERVAL_S)
        for moment in moments:
            self.assertApproximates(moment / SWEEP_INTERVAL_S, round(moment / SWEEP_INTERVAL_S), 1e-6)
        fleet.run(2 * MAX_SWEEP_INTERVAL_S)
        self.assertLess(len(moments), 6)

    def test_who_leases_nothing_says_nothing(self) -> None:
        """A node without leased records sends no renewals; after its first lease it renews at the usual interval."""
        fleet = self.fleet(2)
        node = fleet.nodes[0]
        beats: list[float] = []
        extend = node.store.extend_leases

        def extended(owner: bytes, expires_at: float) -> int:
            if owner == node.identity.public:
                beats.append(fleet.clock.seconds())
            return extend(owner, expires_at)

        self.patch(node.store, "extend_leases", extended)
        fleet.run(30.0)
        self.assertLess(len(beats), 2)
        self.done(fleet, node.put(KEY, "a", b"1", "leased"), 0.5)
        fleet.run(10.0)
        self.assertGreater(len(beats), 25)
        self.assertEqual(len(self.done(fleet, fleet.nodes[1].get(KEY), 0.5)), 1)

    def test_a_store_knows_what_is_due(self) -> None:
        """A store returns the earliest expiry time of its records, or infinity if it is empty."""
        store = MemoryStore()
        self.assertEqual(store.next_expiry(), float("inf"))
        store.put(record("b", 60.0), 60.0)
        store.put(record("a", 20.0), 20.0)
        self.assertEqual(store.next_expiry(), 20.0)
        store.expire(20.0)
        self.assertEqual(store.next_expiry(), 60.0)
