"""Tests of views and watches; pure."""

from __future__ import annotations

from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.identity import Identity
from middleware.entangled.record import Lifetime, Record, hashed_key
from middleware.entangled.replication.watch import View, Watch, digest_of

DOG, CAT, ME = (Identity(bytes([n]) * 32) for n in (1, 2, 3))
KEY = hashed_key("devices")


def record(owner: Identity, sequence: int = 1, value: bytes | None = b"v", lifetime: Lifetime = "leased") -> Record:
    """A record of ``owner``; views do not look at signatures."""
    return Record(KEY, "state", owner.public, sequence, lifetime, 1.0, value, bytes(64))


class ViewTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.view = View(ME.node_id)

    def test_any_replica_suffices(self) -> None:
        """A slot is there while one replica still says so, and gone with the last one."""
        self.view.replace(CAT.node_id, [record(DOG)])
        self.view.add(ME.node_id, record(DOG))
        self.view.remove(CAT.node_id, record(DOG).slot)
        self.assertEqual(self.view.merged(), [record(DOG)])
        self.view.forget(ME.node_id)
        self.assertEqual(self.view.merged(), [])

    def test_the_stronger_record_holds(self) -> None:
        """Of two opinions on a slot the higher sequence is shown, whoever speaks first; a replica never goes back."""
        for order in ((1, 2), (2, 1)):
            view = View()
            for replica, sequence in zip((CAT, ME), order, strict=True):
                view.add(replica.node_id, record(DOG, sequence))
            self.assertEqual(view.merged(), [record(DOG, 2)])
        self.view.add(CAT.node_id, record(DOG, 2))
        self.view.add(CAT.node_id, record(DOG, 1))
        self.assertEqual(self.view.merged(), [record(DOG, 2)])

    def test_tombstone_hides(self) -> None:
        """A newer tombstone of one replica hides what others still hold."""
        self.view.replace(CAT.node_id, [record(DOG)])
        self.view.replace(ME.node_id, [record(DOG, 2, None, "team")])
        self.assertEqual(self.view.merged(), [])

    def test_nobody_testifies_for_its_own_lease(self) -> None:
        """What a node says of its own lease does not count, its team records do."""
        self.view.replace(DOG.node_id, [record(DOG)])
        self.assertEqual(self.view.merged(), [])
        self.view.replace(DOG.node_id, [record(DOG, lifetime="team")])
        self.assertEqual(len(self.view.merged()), 1)

    def test_digest(self) -> None:
        """The digest is equal for the same records in any order, and another one for any other set."""
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
        """The subscriber hears each change once and no repetition."""
        self.watch.settle()
        self.watch.view.replace(CAT.node_id, [record(DOG)])
        self.watch.settle()
        self.watch.view.replace(ME.node_id, [record(DOG)])
        self.watch.settle()
        self.watch.forget(CAT.node_id)
        self.watch.forget(ME.node_id)
        self.watch.settle()
        self.assertEqual(self.told, [[record(DOG)], []])

    def test_stop(self) -> None:
        """After the end nothing is told, and whoever renews knows."""
        self.watch.stop()
        self.watch.view.replace(CAT.node_id, [record(DOG)])
        self.watch.settle()
        self.assertEqual((self.told, self.ended), ([], [self.watch]))
