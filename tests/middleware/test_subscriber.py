"""Tests of who asks whom to push: in a small team everybody, in a large one a few holders, and where all are full."""

from __future__ import annotations

import random

from middleware.entangled.contact import Contact
from middleware.entangled.network.network import Address
from middleware.entangled.record import Record, hashed_key
from middleware.entangled.replication.pusher import FEW, MAX_TTL, MAX_WATCHERS
from middleware.entangled.replication.subscriber import ASKED, LARGE_TTL
from tests.fleet import Fleet, FleetCase

KEY = hashed_key("watched")
COUNT = 10


class SubscriberTests(FleetCase):
    def asked(self, fleet: Fleet) -> list[tuple[int, float | None]]:
        """Which holder is asked from now on, and for how many seconds, where it is told."""
        asked: list[tuple[int, float | None]] = []
        for place, node in enumerate(fleet.nodes):

            def answer(peer: Contact, key: bytes, digest: bytes, ttl: float = 0.0, place: int = place) -> list[object]:
                asked.append((place, ttl or None))
                return fleet.nodes[place].replica.answer_watch(peer, key, digest, *((ttl,) if ttl else ()))

            node.endpoint.expose("watch", answer, changes=True, idempotent=True)
        return asked

    def large(self, fleet: Fleet, seconds: float) -> None:
        """Let time pass for nodes that take their network for a large one."""
        for _ in range(round(seconds / 0.5)):
            for node in fleet.nodes:
                node.overlay.is_large = True
            fleet.run(0.5)

    def test_small_team(self) -> None:
        """In a team that is known whole every holder is asked every two seconds."""
        fleet = self.fleet(3)
        fleet.run(3.0)
        asked = self.asked(fleet)
        fleet.nodes[2].watch(KEY, lambda records: None)
        fleet.run(9.0)
        self.assertEqual({place for place, _ in asked}, {0, 1})
        self.assertTrue(8 <= len(asked) <= 12, asked)
        self.assertEqual({ttl for _, ttl in asked}, {None})

    def test_large_network(self) -> None:
        """In a large one three holders are asked, seldom, other watchers ask other ones, and all hear at once."""
        fleet = self.fleet(COUNT)
        self.large(fleet, 3.0)
        asked = self.asked(fleet)
        told: list[list[list[Record]]] = [[] for _ in fleet.nodes]
        for node, mine in zip(fleet.nodes, told, strict=True):
            node.watch(KEY, mine.append)
        self.large(fleet, 61.0)
        self.assertLessEqual(len(asked), COUNT * ASKED * 4)
        self.assertEqual({ttl for _, ttl in asked}, {LARGE_TTL})
        self.assertGreater(len({place for place, _ in asked}), ASKED)
        fleet.nodes[4].put(KEY, "news", b"x")
        self.large(fleet, 0.5)
        self.assertEqual([mine[-1][0].value for mine in told if mine], [b"x"] * COUNT)

    def test_a_holder_dies_in_a_large_network(self) -> None:
        """When those that pushed die, others are asked as soon as that is known, and what is new is heard."""
        fleet = self.fleet(COUNT)
        self.large(fleet, 3.0)
        asked = self.asked(fleet)
        told: list[list[Record]] = []
        fleet.nodes[0].watch(KEY, told.append)
        self.large(fleet, 3.0)
        for place in {place for place, _ in asked}:
            fleet.nodes[place].vanish()
        self.large(fleet, 40.0)
        fleet.nodes[0].put(KEY, "news", b"x", concern="one")
        writer = next(node for node in fleet.nodes[1:] if node._running)
        writer.put(KEY, "more", b"y", concern="one")
        self.large(fleet, 2.0)
        self.assertEqual(sorted(r.value or b"" for r in told[-1]), [b"x", b"y"])

    def test_where_all_are_full(self) -> None:
        """Who comes when a key has as many watchers as there may be reads it every two seconds instead."""
        fleet = self.fleet(COUNT)
        fleet.run(3.0)
        dice = random.Random(1)
        crowd = [Contact(dice.randbytes(32), Address("10.0.0.9", 9)) for _ in range(MAX_WATCHERS)]
        for node in fleet.nodes:
            for contact in crowd:
                node.replica.pusher.watched(KEY, contact, MAX_TTL)
        outsider = next(n for n in fleet.nodes if not n.overlay.belongs(KEY, n.contact))
        told: list[list[Record]] = []
        outsider.watch(KEY, told.append)
        self.done(fleet, next(n for n in fleet.nodes if n is not outsider).put(KEY, "news", b"x"), 1.0)
        fleet.run(1.5)
        self.assertEqual([record.value for record in told[-1]], [b"x"])

    def test_many_changes_for_many_watchers(self) -> None:
        """Where a key has many watchers, changes of one moment go out together, and the last word of a slot holds."""
        fleet = self.fleet(3)
        fleet.run(3.0)
        dice = random.Random(1)
        for _ in range(FEW + 1):
            contact = Contact(dice.randbytes(32), Address("10.0.0.9", 9))
            for node in fleet.nodes:
                node.replica.pusher.watched(KEY, contact, MAX_TTL)
        told: list[list[Record]] = []
        fleet.nodes[2].watch(KEY, told.append)
        fleet.run(1.0)
        pushes = [node.replica.pusher._watchers[KEY][fleet.nodes[2].identity.node_id] for node in fleet.nodes[:2]]
        for number in range(100):
            fleet.nodes[0].put(KEY, f"task {number}", b"x" * 300)
        fleet.run(1.0)
        self.assertEqual(len(told[-1]), 100)
        self.assertLess(sum(watcher.number for watcher in pushes), 30)
        fleet.nodes[0].put(KEY, "comes and goes", b"y", "leased")
        fleet.nodes[0].release(KEY, "comes and goes")
        fleet.nodes[1].put(KEY, "goes and comes", b"y", "leased")
        fleet.run(1.0)
        fleet.nodes[1].release(KEY, "goes and comes")
        fleet.nodes[1].put(KEY, "goes and comes", b"z", "leased")
        fleet.run(0.5)
        self.assertEqual([r.value for r in told[-1] if r.name == "goes and comes"], [b"z"])
        fleet.run(3.0)
        self.assertEqual([r.value for r in told[-1] if len(r.value or b"") < 300], [b"z"])
