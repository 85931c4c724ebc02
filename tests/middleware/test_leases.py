"""Tests of leased records with different TTLs, and of the renewal interval."""

from __future__ import annotations

from middleware.entangled.record import hash_key
from tests.fleet import EntangledTeam, FleetCase

KEY = hash_key("leases")
OTHER = hash_key("others")


class LeaseTests(FleetCase):
    def names(self, fleet: EntangledTeam, key: bytes = KEY, place: int = 0) -> list[str]:
        return [record.name for record in fleet.nodes[place].store.get(key, tombstones=True)]

    def told(self, fleet: EntangledTeam, place: int, seconds: float) -> list[float]:
        """Return the TTLs in the renewals that the node with index ``place`` receives in this time."""
        told: list[float] = []
        replica = fleet.nodes[place].replica
        answer = replica.answer_alive

        def heard(peer: object, lease: float, digest: bytes) -> None:
            told.append(lease)
            answer(peer, lease, digest)  # type: ignore[arg-type]

        fleet.nodes[place].endpoint.expose("alive", heard, changes=True, idempotent=True)
        fleet.run(seconds)
        return told

    def test_each_its_own(self) -> None:
        """After its owner fails, a record with a 1 s lease expires within 1.2 s.

        A record with a 12 s lease takes 12 s.
        """
        fleet = self.fleet(3)
        fleet.nodes[2].put(KEY, "short", b"x", "leased")
        fleet.nodes[1].put(KEY, "long", b"x", "leased", lease=12.0)
        fleet.run(30.0)
        self.assertEqual(sorted(self.names(fleet)), ["long", "short"])
        fleet.nodes[1].stop_silently()
        fleet.nodes[2].stop_silently()
        fleet.run(1.2)
        self.assertEqual(self.names(fleet), ["long"])
        fleet.run(6.7)
        self.assertEqual(self.names(fleet), ["long"])
        fleet.run(4.2)
        self.assertEqual(self.names(fleet), [])

    def test_signs_are_as_seldom_as_the_lease_is_long(self) -> None:
        """A node with a lease of 60 s renews it three times per minute."""
        fleet = self.fleet(2)
        fleet.nodes[1].put(KEY, "long", b"x", "leased", lease=60.0)
        fleet.run(30.0)
        self.assertEqual(self.told(fleet, 0, 60.0), [60.0] * 3)

    def test_the_shorter_one_is_told(self) -> None:
        """A node with a long and a short lease renews at the short interval.

        After it released the short lease, it renews at the long interval.
        """
        fleet = self.fleet(2)
        fleet.nodes[1].put(KEY, "long", b"x", "leased", lease=60.0)
        fleet.nodes[1].put(OTHER, "short", b"x", "leased")
        fleet.run(30.0)
        self.assertEqual(self.told(fleet, 0, 6.0), [1.0] * 18)
        fleet.nodes[1].release(OTHER, "short")
        fleet.run(30.0)
        self.assertEqual(self.told(fleet, 0, 60.0), [60.0] * 3)

    def test_who_has_the_long_one_only(self) -> None:
        """A replica that stores only records with the long lease receives renewals at the long interval."""
        fleet = self.fleet(10)
        fleet.run(3.0)
        owner = fleet.nodes[1]
        others = (hash_key(f"other {n}") for n in range(100))
        places = [n for n in range(10) if n != 1 and owner.overlay.is_replica(KEY, fleet.nodes[n].contact)]
        key, place = next(
            (other, n)
            for other in others
            for n in places
            if not owner.overlay.is_replica(other, fleet.nodes[n].contact)
        )
        owner.put(KEY, "long", b"x", "leased", lease=60.0)
        owner.put(key, "short", b"x", "leased")
        fleet.run(30.0)
        self.assertEqual(self.told(fleet, place, 60.0), [60.0] * 3)

    def test_a_short_one_comes_later(self) -> None:
        """A short lease that starts between two renewals of a long lease is renewed from its start."""
        fleet = self.fleet(3)
        fleet.nodes[1].put(KEY, "long", b"x", "leased", lease=60.0)
        fleet.run(25.0)
        fleet.nodes[1].put(KEY, "short", b"x", "leased")
        for _ in range(100):
            fleet.run(0.3)
            self.assertEqual(sorted(self.names(fleet)), ["long", "short"])

    def test_release(self) -> None:
        """A released record disappears at its owner immediately, and at the replicas within its lease.

        Other records stay, and the slot can be used again immediately.
        """
        fleet = self.fleet(3)
        fleet.nodes[1].put(KEY, "stays", b"x", "leased", lease=6.0)
        fleet.nodes[1].put(OTHER, "goes", b"x", "leased", lease=6.0)
        fleet.run(10.0)
        fleet.nodes[1].release(OTHER, "goes")
        self.assertEqual(self.names(fleet, OTHER, 1), [])
        fleet.run(6.5)
        for place in range(3):
            self.assertEqual((self.names(fleet, KEY, place), self.names(fleet, OTHER, place)), (["stays"], []), place)
        fleet.nodes[1].put(OTHER, "goes", b"y", "leased", lease=6.0)
        fleet.nodes[1].release(OTHER, "goes")
        fleet.nodes[1].put(OTHER, "goes", b"z", "leased", lease=6.0)
        fleet.run(30.0)
        self.assertEqual([r.value for r in fleet.nodes[0].store.get(OTHER)], [b"z"])

    def test_what_the_team_keeps_is_not_released(self) -> None:
        """``release`` does not affect a record that outlives its owner."""
        fleet = self.fleet(2)
        self.done(fleet, fleet.nodes[1].put(KEY, "kept", b"x"), 1.0)
        fleet.nodes[1].release(KEY, "kept")
        fleet.run(5.0)
        self.assertEqual(self.names(fleet), ["kept"])

    def test_the_nodes_lease_changes(self) -> None:
        """A record stays for the longer of the record's lease and the node's lease, which can change."""
        fleet = self.fleet(2)
        fleet.nodes[1].put(OTHER, "short", b"x", "leased", lease=0.1)
        fleet.run(5.0)
        self.assertEqual(self.told(fleet, 0, 3.0), [1.0] * 9)
        fleet.nodes[1].release(OTHER, "short")
        fleet.nodes[1].put(KEY, "long", b"x", "leased", lease=6.0)
        fleet.run(3.0)
        fleet.nodes[1].set_lease(30.0)
        fleet.run(1.0)
        self.assertEqual(self.told(fleet, 0, 60.0), [30.0] * 6)
        fleet.nodes[1].set_lease(1.0)
        fleet.run(3.0)
        self.assertEqual(self.told(fleet, 0, 12.0), [6.0] * 6)
