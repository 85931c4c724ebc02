"""Tests of views and watches, and of subscriptions at the replicas."""

from __future__ import annotations

import random

from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.contact import Contact
from middleware.entangled.identity import Identity
from middleware.entangled.network.network import Address
from middleware.entangled.record import Lifetime, Record, hash_key
from middleware.entangled.replication.pusher import MAX_IMMEDIATE, MAX_WATCH_TTL_S, MAX_WATCHERS
from middleware.entangled.replication.subscriber import LARGE_TTL_S, MAX_PUSHERS
from middleware.entangled.replication.watch import View, Watch, digest_of
from tests.fleet import EntangledTeam, FleetCase

DOG, CAT, ME = (Identity(bytes([n]) * 32) for n in (1, 2, 3))
KEY = hash_key("devices")


def record(owner: Identity, sequence: int = 1, value: bytes | None = b"v", lifetime: Lifetime = "leased") -> Record:
    """Return a record of ``owner``, unsigned because views do not verify signatures."""
    return Record(KEY, "state", owner.public, sequence, lifetime, 1.0, value, bytes(64))


class ViewTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.view = View(ME.node_id)

    def test_any_replica_suffices(self) -> None:
        """A slot is visible if at least one replica reports it."""
        self.view.replace(CAT.node_id, [record(DOG)])
        self.view.add(ME.node_id, record(DOG))
        self.view.remove(CAT.node_id, record(DOG).slot)
        self.assertEqual(self.view.merge(), [record(DOG)])
        self.view.forget(ME.node_id)
        self.assertEqual(self.view.merge(), [])

    def test_the_stronger_record_holds(self) -> None:
        """The record with the higher sequence wins in any order of arrival; a replica's lower sequence is ignored."""
        for order in ((1, 2), (2, 1)):
            view = View()
            for replica, sequence in zip((CAT, ME), order, strict=True):
                view.add(replica.node_id, record(DOG, sequence))
            self.assertEqual(view.merge(), [record(DOG, 2)])
        self.view.add(CAT.node_id, record(DOG, 2))
        self.view.add(CAT.node_id, record(DOG, 1))
        self.assertEqual(self.view.merge(), [record(DOG, 2)])

    def test_tombstone_hides(self) -> None:
        """A newer tombstone at one replica hides an older record at other replicas."""
        self.view.replace(CAT.node_id, [record(DOG)])
        self.view.replace(ME.node_id, [record(DOG, 2, None, "team")])
        self.assertEqual(self.view.merge(), [])

    def test_nobody_testifies_for_its_own_lease(self) -> None:
        """The report of an owner does not count for its own leased record, but counts for its team record."""
        self.view.replace(DOG.node_id, [record(DOG)])
        self.assertEqual(self.view.merge(), [])
        self.view.replace(DOG.node_id, [record(DOG, lifetime="team")])
        self.assertEqual(len(self.view.merge()), 1)

    def test_digest(self) -> None:
        """Equal sets of records have the same digest in any order; different sets have different digests."""
        records = [record(DOG), record(CAT)]
        self.view.replace(ME.node_id, records)
        self.assertEqual(self.view.digest(ME.node_id), digest_of(records[::-1]))
        others = [records[:1], [record(DOG, 2), records[1]], []]
        self.assertEqual(len({digest_of(each) for each in (records, *others)}), 4)
        self.assertEqual(self.view.digest(CAT.node_id), digest_of([]))


class WatchTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.told: list[list[Record]] = []
        self.ended: list[Watch] = []
        self.watch = Watch(KEY, self.told.append, self.ended.append)

    def test_tell_changes_only(self) -> None:
        """The subscriber is notified of each change once."""
        self.watch.update()
        self.watch.view.replace(CAT.node_id, [record(DOG)])
        self.watch.update()
        self.watch.view.replace(ME.node_id, [record(DOG)])
        self.watch.update()
        self.watch.forget(CAT.node_id)
        self.watch.forget(ME.node_id)
        self.watch.update()
        self.assertEqual(self.told, [[record(DOG)], []])

    def test_stop(self) -> None:
        """After a stop the subscriber receives no change, and the end is reported once."""
        self.watch.stop()
        self.watch.view.replace(CAT.node_id, [record(DOG)])
        self.watch.update()
        self.assertEqual((self.told, self.ended), ([], [self.watch]))


COUNT = 10


class SubscriberTests(FleetCase):
    def asked(self, fleet: EntangledTeam) -> list[tuple[int, float | None]]:
        """Return a list that will contain the holder and the TTL (or None) of each later watch request."""
        asked: list[tuple[int, float | None]] = []
        for place, node in enumerate(fleet.nodes):

            def answer(peer: Contact, key: bytes, digest: bytes, ttl: float = 0.0, place: int = place) -> list[object]:
                asked.append((place, ttl or None))
                return fleet.nodes[place].replica.answer_watch(peer, key, digest, *((ttl,) if ttl else ()))

            node.endpoint.expose("watch", answer, changes=True, idempotent=True)
        return asked

    def large(self, fleet: EntangledTeam, seconds: float) -> None:
        """Advance the clock while all nodes assume a large network."""
        for _ in range(round(seconds / 0.5)):
            for node in fleet.nodes:
                node.overlay.is_large = True
            fleet.run(0.5)

    def test_small_team(self) -> None:
        """In a small team every holder is queried every two seconds."""
        fleet = self.fleet(3)
        fleet.run(3.0)
        asked = self.asked(fleet)
        fleet.nodes[2].watch(KEY, lambda records: None)
        fleet.run(9.0)
        self.assertEqual({place for place, _ in asked}, {0, 1})
        self.assertTrue(8 <= len(asked) <= 12, asked)
        self.assertEqual({ttl for _, ttl in asked}, {None})

    def test_large_network(self) -> None:
        """In a large network a watcher subscribes rarely, and only at three holders, which differ between watchers."""
        fleet = self.fleet(COUNT)
        self.large(fleet, 3.0)
        asked = self.asked(fleet)
        told: list[list[list[Record]]] = [[] for _ in fleet.nodes]
        for node, mine in zip(fleet.nodes, told, strict=True):
            node.watch(KEY, mine.append)
        self.large(fleet, 61.0)
        self.assertLessEqual(len(asked), COUNT * MAX_PUSHERS * 4)
        self.assertEqual({ttl for _, ttl in asked}, {LARGE_TTL_S})
        self.assertGreater(len({place for place, _ in asked}), MAX_PUSHERS)
        fleet.nodes[4].put(KEY, "news", b"x")
        self.large(fleet, 0.5)
        self.assertEqual([mine[-1][0].value for mine in told if mine], [b"x"] * COUNT)

    def test_a_holder_dies_in_a_large_network(self) -> None:
        """If the holders that push changes fail, the watcher subscribes at other holders, and gets new records."""
        fleet = self.fleet(COUNT)
        self.large(fleet, 3.0)
        asked = self.asked(fleet)
        told: list[list[Record]] = []
        fleet.nodes[0].watch(KEY, told.append)
        self.large(fleet, 3.0)
        for place in {place for place, _ in asked}:
            fleet.nodes[place].stop_silently()
        self.large(fleet, 40.0)
        fleet.nodes[0].put(KEY, "news", b"x", concern="one")
        writer = next(node for node in fleet.nodes[1:] if node._running)
        writer.put(KEY, "more", b"y", concern="one")
        self.large(fleet, 2.0)
        self.assertEqual(sorted(r.value or b"" for r in told[-1]), [b"x", b"y"])

    def test_where_all_are_full(self) -> None:
        """If a key already has the maximum number of watchers, a further watcher reads the key every two seconds."""
        fleet = self.fleet(COUNT)
        fleet.run(3.0)
        dice = random.Random(1)
        crowd = [Contact(dice.randbytes(32), Address("10.0.0.9", 9)) for _ in range(MAX_WATCHERS)]
        for node in fleet.nodes:
            for contact in crowd:
                node.replica.pusher.add_watcher(KEY, contact, MAX_WATCH_TTL_S)
        outsider = next(n for n in fleet.nodes if not n.overlay.is_replica(KEY, n.contact))
        told: list[list[Record]] = []
        outsider.watch(KEY, told.append)
        self.done(fleet, next(n for n in fleet.nodes if n is not outsider).put(KEY, "news", b"x"), 1.0)
        fleet.run(1.5)
        self.assertEqual([record.value for record in told[-1]], [b"x"])

    def test_many_changes_for_many_watchers(self) -> None:
        """Simultaneous changes for many watchers of a key are sent together, with the latest record of each slot."""
        fleet = self.fleet(3)
        fleet.run(3.0)
        dice = random.Random(1)
        for _ in range(MAX_IMMEDIATE + 1):
            contact = Contact(dice.randbytes(32), Address("10.0.0.9", 9))
            for node in fleet.nodes:
                node.replica.pusher.add_watcher(KEY, contact, MAX_WATCH_TTL_S)
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
