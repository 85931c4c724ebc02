"""Tests of write and read concerns, of compare-and-set and of what else the node promises of records."""

from __future__ import annotations

from typing import Any

from twisted.internet.defer import Deferred

from middleware.entangled.errors import Conflict, NotAcknowledged, Unavailable
from middleware.entangled.kademlia.distance import closest
from middleware.entangled.kademlia.overlay import K
from middleware.entangled.node import EntangledNode
from middleware.entangled.record import TOLERATED_ABSENCE, TOMBSTONE_TTL, Record, hashed_key
from middleware.entangled.replication.owner import Concern
from middleware.entangled.replication.replica import CACHED, SURE
from tests.fleet import TEAM, Fleet, FleetCase

KEY = hashed_key("task")


class ConcernCase(FleetCase):
    """A few words for what most tests do."""

    def cut(self, fleet: Fleet, *places: int) -> None:
        fleet.board.partition([fleet.address(place) for place in places])

    def failure(self, fleet: Fleet, work: Any, kind: type[Exception], within: float = 3.0) -> Any:
        fleet.run(within)
        return self.failureResultOf(work, kind).value

    def values(self, fleet: Fleet, place: int, concern: Any = "majority", key: bytes = KEY) -> list[bytes | None]:
        return [r.value for r in self.done(fleet, fleet.nodes[place].get(key, concern))]


class WriteConcernTests(ConcernCase):
    def test_how_many_have_it(self) -> None:
        """Each concern is met before the writer is told, and what it is told is at least that."""
        fleet = self.fleet(5)
        concerns: tuple[tuple[Concern, int], ...] = (("one", 1), ("majority", 3), ("all", 5))
        for concern, least in concerns:
            stored = self.done(fleet, fleet.nodes[0].put(KEY, "state", b"x", "team", concern))
            self.assertGreaterEqual(stored, least)

    def test_named_error_says_how_many(self) -> None:
        """With two of five cut off ``all`` fails and says that three have it; a minority fails ``majority``."""
        fleet = self.fleet(5)
        self.cut(fleet, 3, 4)
        error = self.failure(fleet, fleet.nodes[0].put(KEY, "a", b"x", "team", "all"), NotAcknowledged)
        self.assertEqual((error.acknowledged, error.needed), (3, 5))
        error = self.failure(fleet, fleet.nodes[3].put(KEY, "b", b"x"), NotAcknowledged)
        self.assertEqual((error.acknowledged, error.needed), (2, 3))
        self.assertEqual(self.done(fleet, fleet.nodes[3].put(KEY, "c", b"x", "team", "one")) >= 1, True)

    def test_one_after_the_other_may_die(self) -> None:
        """A majority that is in touch goes on without the dead, until two of five are left; then writes still work."""
        fleet = self.fleet(5)
        for place in (4, 3, 2):
            fleet.nodes[place].vanish()
            fleet.run(50.0)
        self.assertEqual(self.done(fleet, fleet.nodes[0].put(KEY, "a", b"x")), 2)


class CompareAndSetTests(ConcernCase):
    def test_only_what_was_expected_is_replaced(self) -> None:
        """A first write expects 0, the next one the number of the last; any other number is a conflict."""
        fleet = self.fleet(3)
        first = self.done(fleet, fleet.nodes[0].put(KEY, "a", b"1", expect=0))
        conflict = self.failure(fleet, fleet.nodes[0].put(KEY, "a", b"2", expect=0), Conflict)
        self.assertEqual((conflict.expected, conflict.sequence), (0, first.sequence))
        second = self.done(fleet, fleet.nodes[0].put(KEY, "a", b"2", expect=first.sequence))
        self.assertGreater(second.sequence, first.sequence)
        self.done(fleet, fleet.nodes[0].remove(KEY, "a", expect=second.sequence))
        self.assertEqual(self.values(fleet, 1), [])

    def test_two_at_once(self) -> None:
        """Of two writes that expect the same number one wins."""
        fleet = self.fleet(3)
        works = [fleet.nodes[0].put(KEY, "a", value, expect=0) for value in (b"1", b"2")]
        fleet.run(1.0)
        self.successResultOf(works[0])
        self.failureResultOf(works[1], Conflict)
        self.assertEqual(self.values(fleet, 1), [b"1"])

    def test_a_former_life_is_not_overwritten(self) -> None:
        """A node that lost its store does not replace by compare-and-set what its former life has left."""
        fleet = self.fleet(3)
        old = self.done(fleet, fleet.nodes[2].put(KEY, "a", b"old"))
        fleet.nodes[2].vanish()
        fleet.stores.pop(2)
        fleet.restart(2)
        fleet.run(1.0)
        fleet.stores[2].discard(Record(KEY, "a", fleet.identity(2).public, 1, "team", 1.0, b"").slot)
        conflict = self.failure(fleet, fleet.nodes[2].put(KEY, "a", b"new", expect=0), Conflict)
        self.assertEqual(conflict.sequence, old.sequence)
        self.assertEqual(self.values(fleet, 0), [b"old"])


class ReadConcernTests(ConcernCase):
    def setUp(self) -> None:
        super().setUp()
        self.world = self.fleet(14, seed=4)
        nodes = closest([node.contact for node in self.world.nodes], KEY, 14)
        self.order = [contact.address.port - 7000 for contact in nodes]
        self.reader: EntangledNode = self.world.nodes[self.order[-1]]

    def sent(self) -> int:
        return self.world.board.counters["sent"]

    def test_fast_costs_two_datagrams(self) -> None:
        """Where everybody is known, a fast read is one question and one answer, a write 8 of each."""
        put = self.reader.put(KEY, "a", b"x")
        self.world.run(0.001)
        self.successResultOf(put)
        before = self.sent()
        read = self.reader.get(KEY, "fast")
        self.world.run(0.001)
        self.assertEqual([r.value for r in self.successResultOf(read)], [b"x"])
        self.assertEqual(self.sent() - before, 2)
        before = self.sent()
        self.reader.put(KEY, "a", b"y")
        self.world.run(0.001)
        self.assertEqual(self.sent() - before, 2 * K)

    def test_a_dead_replica_is_not_waited_for(self) -> None:
        """Right after a death reads are hedged: with half of the holders silent fast ones are answered in 60 ms."""
        self.done(self.world, self.reader.put(KEY, "a", b"x", "team", "all"))
        for place in self.order[:4]:
            self.world.nodes[place].vanish()
        for _ in range(10):
            read = self.reader.get(KEY, "fast")
            self.world.run(0.06)
            self.assertEqual([r.value for r in self.successResultOf(read)], [b"x"])
        self.failure(self.world, self.reader.get(KEY), Unavailable)

    def test_read_repair(self) -> None:
        """What a majority read shows, a majority has by then, though one replica only had it before."""
        writer = self.world.nodes[self.order[0]]
        made = Record(KEY, "a", writer.identity.public, 7, "team", 6000.0, b"x").signed(writer.identity)
        self.world.nodes[self.order[1]].replica.keep(made)
        while not self.done(self.world, self.reader.get(KEY), 0.01):
            pass
        holding = [place for place in self.order[:K] if self.world.stores[place].get(KEY)]
        self.assertGreater(len(holding), K // 2)

    def test_nothing_is_said_by_a_majority_only(self) -> None:
        """That a key is empty takes a majority to say; while it cannot be asked, a read fails by name."""
        self.assertEqual(self.values(self.world, self.order[-1], "fast"), [])
        for place in self.order[:5]:
            self.world.nodes[place].vanish()
        error = self.failure(self.world, self.reader.get(KEY, "fast"), Unavailable)
        self.assertEqual((error.answered, error.needed), (3, 5))


class NewcomerTests(ConcernCase):
    def test_second_node_reads_as_soon_as_it_has_joined(self) -> None:
        """Of two nodes both have to vote; the one that has just come can read all the same, and surely."""

        async def joined_and_read(fleet: Fleet) -> list[Record]:
            fleet.nodes.append(fleet.made(1))
            await fleet.enter(fleet.nodes[1], [fleet.address(0)])
            return await fleet.nodes[1].get(KEY)

        for seed in range(4):
            fleet = self.fleet(1, seed)
            self.done(fleet, fleet.nodes[0].put(KEY, "a", b"red"))
            read = Deferred.fromCoroutine(joined_and_read(fleet))
            self.assertEqual([record.value for record in self.done(fleet, read)], [b"red"])


class AbsenceTests(ConcernCase):
    def test_a_delete_stays_one(self) -> None:
        """A node that was off during a delete does not bring the record back, however it comes back."""
        fleet = self.fleet(5)
        self.done(fleet, fleet.nodes[0].put(KEY, "a", b"x", "team", "all"))
        fleet.nodes[3].vanish()
        self.cut(fleet, 4)
        self.done(fleet, fleet.nodes[0].remove(KEY, "a"))
        fleet.nodes[0].vanish()
        fleet.run(40.0)
        fleet.board.heal()
        fleet.restart(3, [1])
        fleet.run(30.0)
        for place in (1, 2, 3, 4):
            self.assertEqual(self.values(fleet, place), [])
            self.assertEqual(fleet.stores[place].get(KEY), [])

    def test_long_absence_means_empty(self) -> None:
        """A node that was away for longer than tombstones are kept re-joins empty, a shorter absence costs nothing."""
        self.assertGreater(TOMBSTONE_TTL, TOLERATED_ABSENCE)
        for away, kept in ((TOLERATED_ABSENCE - 60.0, 1), (TOLERATED_ABSENCE + 60.0, 0)):
            fleet = self.fleet(1)
            moment = [1000.0]
            fleet.nodes[0].stop()
            for expected in (1, kept):
                node = self.life(fleet, moment)
                if expected == 1 and not fleet.stores[0].get(KEY):
                    self.done(fleet, node.put(KEY, "a", b"x"), 0.1)
                self.assertEqual(len(fleet.stores[0].get(KEY)), expected)
                node.stop()
                moment[0] += away

    def life(self, fleet: Fleet, moment: list[float]) -> EntangledNode:
        """One life of the node of place 0, with a wall clock."""
        network = fleet.board.network(*fleet.address(0))
        node = EntangledNode(
            fleet.identity(0), TEAM, network, fleet.store(0), fleet.clock, fleet.rng(0), wall=lambda: moment[0]
        )
        fleet.nodes[0] = node
        node.start()
        node.join([])
        fleet.run(31.0)
        return node


class WatchNumberTests(ConcernCase):
    def test_a_gap_is_noticed_and_filled(self) -> None:
        """A watcher that missed a push sees by the number of the next one that it did, and asks at once."""
        fleet = self.fleet(2)
        told: list[list[bytes | None]] = []
        watch = fleet.nodes[1].watch(KEY, lambda records: told.append([r.value for r in records]))
        fleet.run(0.5)
        owner, pusher = fleet.identity(0), fleet.nodes[0].replica.pusher
        missed = Record(KEY, "a", owner.public, 1, "team", 60.0, b"missed").signed(owner)
        fleet.stores[0].put(missed, fleet.clock.seconds() + 60.0)
        watcher = pusher._watchers[KEY][fleet.nodes[1].identity.node_id]
        watcher.number += 1
        seen = Record(KEY, "b", owner.public, 2, "team", 60.0, b"seen").signed(owner)
        fleet.nodes[0].replica.keep(seen)
        fleet.run(0.1)
        self.assertEqual(told[-1], [b"missed", b"seen"])
        self.assertEqual(watch.pushed[fleet.nodes[0].identity.node_id], 2)


class SecondHandTests(ConcernCase):
    def test_only_the_second_hand_is_verified(self) -> None:
        """Nobody verifies what the owner stores in its own session; whoever gets it from another does."""
        fleet = self.fleet(3)
        owner, other = fleet.identity(1), fleet.nodes[2]
        unsigned = Record(KEY, "x", owner.public, 9, "team", 60.0, b"x", bytes(64))
        held = fleet.nodes[0].replica
        self.assertTrue(held.is_lawful(unsigned, fleet.nodes[1].contact))
        self.assertFalse(held.is_lawful(unsigned, other.contact))
        self.assertTrue(held.is_lawful(unsigned.signed(owner), other.contact))
        fleet.stores[0].put(unsigned, fleet.clock.seconds() + 60.0)
        fleet.run(40.0)
        self.assertEqual([len(fleet.stores[place].get(KEY)) for place in range(3)], [1, 0, 0])


class WalkTests(ConcernCase):
    def test_copies_on_the_path(self) -> None:
        """In a network that nobody knows whole a popular value is copied along the way, and never counted as sure."""
        fleet = self.fleet(30, seed=5)
        self.done(fleet, fleet.nodes[0].put(KEY, "a", b"x"))
        for node in fleet.nodes:
            node._membership._large_until = 1e9
            node.overlay.is_whole = False
            for member in node.overlay.roster.live():
                node.overlay.roster.left(member.node_id)
        order = closest([node.contact for node in fleet.nodes], KEY, 30)
        far = fleet.nodes[order[-1].address.port - 7000]
        for holder in order[:K]:
            far.overlay.table.remove(holder)
            far.overlay.roster.left(holder.node_id)
        read = far.get(KEY, "fast")
        fleet.run(0.01)
        self.assertEqual([r.value for r in self.successResultOf(read)], [b"x"])
        copies = [node for node in fleet.nodes if node.replica.cache.get(KEY, fleet.clock.seconds())]
        for node in copies:
            self.assertEqual(node.replica.held(KEY), [])
            peer = fleet.nodes[0].contact
            self.assertEqual(node.replica.answer_find_value(peer, KEY, None)[2], CACHED)
            self.assertEqual(node.replica.answer_find_value(peer, KEY, None, True)[:3], [[], None, SURE])
        self.assertGreater(len(copies), 0)
        fleet.run(61.0)
        self.assertEqual([n for n in fleet.nodes if n.replica.cache.get(KEY, fleet.clock.seconds())], [])
