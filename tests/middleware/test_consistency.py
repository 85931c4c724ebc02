"""Tests of the guarantees of the consistency levels under joins, lost stores and partitions."""

from __future__ import annotations

from typing import Any

from twisted.internet.defer import Deferred

from middleware.entangled.data.memory import MemoryStore
from middleware.entangled.errors import Conflict, NotAcknowledged, Unavailable
from middleware.entangled.identity import Identity
from middleware.entangled.kademlia.distance import select_closest
from middleware.entangled.kademlia.member_table import ABSENT_WITH_MAJORITY_S, MAX_ABSENT_S
from middleware.entangled.kademlia.overlay import K
from middleware.entangled.network.switchboard import LinkConditions
from middleware.entangled.node import EntangledNode
from middleware.entangled.record import TOLERATED_ABSENCE_S, TOMBSTONE_TTL_S, Record, hash_key
from middleware.entangled.replication.owner import ConsistencyLevel, Stored
from middleware.entangled.replication.replica import CACHED_REPLY, SYNCED_REPLY
from middleware.entangled.replication.store_reply import Outcome
from tests.fleet import TEAM_KEY, EntangledTeam, FleetCase

KEY = hash_key("task")


class ConsistencyCase(FleetCase):
    """A test case with helpers for these tests."""

    def cut(self, fleet: EntangledTeam, *places: int) -> None:
        fleet.switchboard.partition([fleet.address(place) for place in places])

    def failure(self, fleet: EntangledTeam, work: Any, kind: type[Exception], within: float = 3.0) -> Any:
        fleet.run(within)
        return self.failureResultOf(work, kind).value

    def outcome(self, fleet: EntangledTeam, work: Deferred[Any], within: float = 5.0) -> Any:
        """Return the result or the exception of ``work``."""
        results: list[Any] = []
        work.addErrback(lambda failure: failure.value).addCallback(results.append)
        fleet.run(within)
        return results[0] if results else None

    def values(self, fleet: EntangledTeam, place: int, concern: Any = "majority") -> Any:
        """Return the values that a node reads, or the type of its error."""
        found = self.outcome(fleet, fleet.nodes[place].get(KEY, concern))
        return [record.value for record in found] if isinstance(found, list) else type(found)

    def joined(self, fleet: EntangledTeam, count: int, known: int) -> None:
        """Let new nodes join through one node."""
        for _ in range(count):
            place = len(fleet.nodes)
            fleet.nodes.append(fleet.make_node(place))
            fleet.start_node(fleet.nodes[place], [fleet.address(known)])
            fleet.run(0.3)


class WriteConsistencyTests(ConsistencyCase):
    def test_how_many_have_it(self) -> None:
        """A write at each consistency level is acknowledged by at least the required number of replicas."""
        fleet = self.fleet(5)
        concerns: tuple[tuple[ConsistencyLevel, int], ...] = (("one", 1), ("majority", 3), ("all", 5))
        for concern, least in concerns:
            stored = self.done(fleet, fleet.nodes[0].put(KEY, "state", b"x", "team", concern))
            self.assertGreaterEqual(stored, least)

    def test_named_error_says_how_many(self) -> None:
        """If two of five nodes are cut off, a write at level ``all`` fails with three acknowledgements.

        At the two nodes a write at level ``majority`` fails.
        """
        fleet = self.fleet(5)
        self.cut(fleet, 3, 4)
        error = self.failure(fleet, fleet.nodes[0].put(KEY, "a", b"x", "team", "all"), NotAcknowledged)
        self.assertEqual((error.acknowledged, error.needed), (3, 5))
        error = self.failure(fleet, fleet.nodes[3].put(KEY, "b", b"x"), NotAcknowledged)
        self.assertEqual((error.acknowledged, error.needed), (2, 3))
        self.assertEqual(self.done(fleet, fleet.nodes[3].put(KEY, "c", b"x", "team", "one")) >= 1, True)

    def test_one_after_the_other_may_die(self) -> None:
        """Nodes fail one after the other; the team still writes with a majority when two of five nodes are left."""
        fleet = self.fleet(5)
        for place in (4, 3, 2):
            fleet.nodes[place].stop_silently()
            fleet.run(50.0)
        self.assertEqual(self.done(fleet, fleet.nodes[0].put(KEY, "a", b"x")), 2)


class CompareAndSetTests(ConsistencyCase):
    def test_only_what_was_expected_is_replaced(self) -> None:
        """The first write expects sequence 0, and the next write the last sequence; any other number is a conflict."""
        fleet = self.fleet(3)
        first = self.done(fleet, fleet.nodes[0].put(KEY, "a", b"1", expect=0))
        conflict = self.failure(fleet, fleet.nodes[0].put(KEY, "a", b"2", expect=0), Conflict)
        self.assertEqual((conflict.expected, conflict.sequence), (0, first.sequence))
        second = self.done(fleet, fleet.nodes[0].put(KEY, "a", b"2", expect=first.sequence))
        self.assertGreater(second.sequence, first.sequence)
        self.done(fleet, fleet.nodes[0].remove(KEY, "a", expect=second.sequence))
        self.assertEqual(self.values(fleet, 1), [])

    def test_two_at_once(self) -> None:
        """Of two concurrent writes that expect the same sequence, one succeeds."""
        fleet = self.fleet(3)
        works = [fleet.nodes[0].put(KEY, "a", value, expect=0) for value in (b"1", b"2")]
        fleet.run(1.0)
        self.successResultOf(works[0])
        self.failureResultOf(works[1], Conflict)
        self.assertEqual(self.values(fleet, 1), [b"1"])

    def test_a_former_life_is_not_overwritten(self) -> None:
        """A compare-and-set of a node that lost its store does not overwrite the node's earlier records."""
        fleet = self.fleet(3)
        old = self.done(fleet, fleet.nodes[2].put(KEY, "a", b"old"))
        fleet.nodes[2].stop_silently()
        fleet.stores.pop(2)
        fleet.restart(2)
        fleet.run(1.0)
        fleet.stores[2].discard(Record(KEY, "a", fleet.identity(2).public, 1, "team", 1.0, b"").slot)
        conflict = self.failure(fleet, fleet.nodes[2].put(KEY, "a", b"new", expect=0), Conflict)
        self.assertEqual(conflict.sequence, old.sequence)
        self.assertEqual(self.values(fleet, 0), [b"old"])


class ReadConsistencyTests(ConsistencyCase):
    def setUp(self) -> None:
        super().setUp()
        self.world = self.fleet(14, seed=4)
        nodes = select_closest([node.contact for node in self.world.nodes], KEY, 14)
        self.order = [contact.address.port - 7000 for contact in nodes]
        self.reader: EntangledNode = self.world.nodes[self.order[-1]]

    def sent(self) -> int:
        return self.world.switchboard.counters["sent"]

    def test_fast_costs_two_datagrams(self) -> None:
        """If all members are known, a fast read takes one request and one reply, and a write eight of each."""
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
        """A fast read ends within 60 ms even if half of the holders have failed, because it queries others early."""
        self.done(self.world, self.reader.put(KEY, "a", b"x", "team", "all"))
        for place in self.order[:4]:
            self.world.nodes[place].stop_silently()
        for _ in range(10):
            read = self.reader.get(KEY, "fast")
            self.world.run(0.06)
            self.assertEqual([r.value for r in self.successResultOf(read)], [b"x"])
        self.failure(self.world, self.reader.get(KEY), Unavailable)

    def test_read_repair(self) -> None:
        """A majority read stores its result at a majority, even if only one replica had the record."""
        writer = self.world.nodes[self.order[0]]
        made = Record(KEY, "a", writer.identity.public, 7, "team", 6000.0, b"x").sign(writer.identity)
        self.world.nodes[self.order[1]].replica.store_locally(made)
        while not self.done(self.world, self.reader.get(KEY), 0.01):
            pass
        holding = [place for place in self.order[:K] if self.world.stores[place].get(KEY)]
        self.assertGreater(len(holding), K // 2)

    def test_nothing_is_said_by_a_majority_only(self) -> None:
        """Only a majority can confirm that a key is empty; without a majority the read fails."""
        self.assertEqual(self.values(self.world, self.order[-1], "fast"), [])
        for place in self.order[:5]:
            self.world.nodes[place].stop_silently()
        error = self.failure(self.world, self.reader.get(KEY, "fast"), Unavailable)
        self.assertEqual((error.answered, error.needed), (3, 5))


class NewcomerTests(ConsistencyCase):
    def test_second_node_reads_as_soon_as_it_has_joined(self) -> None:
        """In a team of two a node can read by majority as soon as it has joined."""

        async def joined_and_read(fleet: EntangledTeam) -> list[Record]:
            fleet.nodes.append(fleet.make_node(1))
            await fleet.start_node(fleet.nodes[1], [fleet.address(0)])
            return await fleet.nodes[1].get(KEY)

        for seed in range(4):
            fleet = self.fleet(1, seed)
            self.done(fleet, fleet.nodes[0].put(KEY, "a", b"red"))
            read = Deferred.fromCoroutine(joined_and_read(fleet))
            self.assertEqual([record.value for record in self.done(fleet, read)], [b"red"])


class AbsenceTests(ConsistencyCase):
    def test_a_delete_stays_one(self) -> None:
        """A node that was offline during a deletion does not restore the deleted record."""
        fleet = self.fleet(5)
        self.done(fleet, fleet.nodes[0].put(KEY, "a", b"x", "team", "all"))
        fleet.nodes[3].stop_silently()
        self.cut(fleet, 4)
        self.done(fleet, fleet.nodes[0].remove(KEY, "a"))
        fleet.nodes[0].stop_silently()
        fleet.run(40.0)
        fleet.switchboard.heal()
        fleet.restart(3, [1])
        fleet.run(30.0)
        for place in (1, 2, 3, 4):
            self.assertEqual(self.values(fleet, place), [])
            self.assertEqual(fleet.stores[place].get(KEY), [])

    def test_long_absence_means_empty(self) -> None:
        """A node that was offline for longer than the TTL of tombstones rejoins empty.

        After a shorter absence nothing is lost.
        """
        self.assertGreater(TOMBSTONE_TTL_S, TOLERATED_ABSENCE_S)
        for away, kept in ((TOLERATED_ABSENCE_S - 60.0, 1), (TOLERATED_ABSENCE_S + 60.0, 0)):
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

    def life(self, fleet: EntangledTeam, moment: list[float]) -> EntangledNode:
        """Start the node with index 0 with a wall clock, and run it for a while."""
        network = fleet.switchboard.make_network(*fleet.address(0))
        node = EntangledNode(
            fleet.identity(0),
            TEAM_KEY,
            network,
            fleet.store(0),
            fleet.clock,
            fleet.make_life_rng(0),
            wall=lambda: moment[0],
        )
        fleet.nodes[0] = node
        node.start()
        node.join([])
        fleet.run(31.0)
        return node


class WatchNumberTests(ConsistencyCase):
    def test_a_gap_is_noticed_and_filled(self) -> None:
        """A watcher detects a lost push by a gap in the numbers of pushes, and requests the records immediately."""
        fleet = self.fleet(2)
        told: list[list[bytes | None]] = []
        watch = fleet.nodes[1].watch(KEY, lambda records: told.append([r.value for r in records]))
        fleet.run(0.5)
        owner, pusher = fleet.identity(0), fleet.nodes[0].replica.pusher
        missed = Record(KEY, "a", owner.public, 1, "team", 60.0, b"missed").sign(owner)
        fleet.stores[0].put(missed, fleet.clock.seconds() + 60.0)
        watcher = pusher._watchers[KEY][fleet.nodes[1].identity.node_id]
        watcher.number += 1
        seen = Record(KEY, "b", owner.public, 2, "team", 60.0, b"seen").sign(owner)
        fleet.nodes[0].replica.store_locally(seen)
        fleet.run(0.1)
        self.assertEqual(told[-1], [b"missed", b"seen"])
        self.assertEqual(watch.push_numbers[fleet.nodes[0].identity.node_id], 2)


class SecondHandTests(ConsistencyCase):
    def test_only_the_second_hand_is_verified(self) -> None:
        """A replica verifies the signature of a record only if another node than the record's owner sends it."""
        fleet = self.fleet(3)
        owner, other = fleet.identity(1), fleet.nodes[2]
        unsigned = Record(KEY, "x", owner.public, 9, "team", 60.0, b"x", bytes(64))
        held = fleet.nodes[0].replica
        self.assertTrue(held.may_accept(unsigned, fleet.nodes[1].contact))
        self.assertFalse(held.may_accept(unsigned, other.contact))
        self.assertTrue(held.may_accept(unsigned.sign(owner), other.contact))
        fleet.stores[0].put(unsigned, fleet.clock.seconds() + 60.0)
        fleet.run(40.0)
        self.assertEqual([len(fleet.stores[place].get(KEY)) for place in range(3)], [1, 0, 0])


class WalkTests(ConsistencyCase):
    def test_copies_on_the_path(self) -> None:
        """A fast read in a large network leaves cached copies on its path, which never count as replicas."""
        fleet = self.fleet(30, seed=5)
        self.done(fleet, fleet.nodes[0].put(KEY, "a", b"x"))
        for node in fleet.nodes:
            node._membership._large_until = 1e9
            node.overlay.has_all_members = False
            for member in node.overlay.members.list_live():
                node.overlay.members.remove(member.node_id)
        order = select_closest([node.contact for node in fleet.nodes], KEY, 30)
        far = fleet.nodes[order[-1].address.port - 7000]
        for holder in order[:K]:
            far.overlay.table.remove(holder)
            far.overlay.members.remove(holder.node_id)
        read = far.get(KEY, "fast")
        fleet.run(0.01)
        self.assertEqual([r.value for r in self.successResultOf(read)], [b"x"])
        copies = [node for node in fleet.nodes if node.replica.cache.get(KEY, fleet.clock.seconds())]
        for node in copies:
            self.assertEqual(node.replica.get_held(KEY), [])
            peer = fleet.nodes[0].contact
            self.assertEqual(node.replica.answer_find_value(peer, KEY, None)[2], CACHED_REPLY)
            self.assertEqual(node.replica.answer_find_value(peer, KEY, None, True)[:3], [[], None, SYNCED_REPLY])
        self.assertGreater(len(copies), 0)
        fleet.run(61.0)
        self.assertEqual([n for n in fleet.nodes if n.replica.cache.get(KEY, fleet.clock.seconds())], [])


class Replaced(MemoryStore):
    """A store that has replaced a corrupted file but still has the notes of this file."""

    origin = "replaced"

    def __init__(self, former: MemoryStore) -> None:
        super().__init__()
        self._notes = dict(former._notes)


class CutTests(ConsistencyCase):
    """Tests of a minority behind a partition, with new nodes, against the majority."""

    def test_newcomers_make_no_majority_of_a_minority(self) -> None:
        """Majority reads and writes fail in a minority, however many new nodes join it."""
        for count, small, newcomers, wait in ((3, (2,), 2, 3.0), (5, (3, 4), 3, 12.0), (4, (2, 3), 3, 0.0)):
            fleet = self.fleet(count)
            self.cut(fleet, *small, *range(count, count + newcomers))
            fleet.run(wait)  # new nodes join before or after the minority learns that the majority is absent
            has_majority = 2 * len(small) < count
            stored = self.outcome(fleet, fleet.nodes[0].put(KEY, "a", b"x"))
            self.assertEqual(type(stored) is NotAcknowledged, not has_majority)
            self.joined(fleet, newcomers, small[0])
            for _ in range(int((ABSENT_WITH_MAJORITY_S + 20.0) / 11.0)):
                self.assertIs(self.values(fleet, small[0]), Unavailable)
                self.assertIs(self.values(fleet, len(fleet.nodes) - 1), Unavailable)
                fleet.run(1.0)
            written = self.outcome(fleet, fleet.nodes[-1].put(KEY, "b", b"y"))
            self.assertIs(type(written), NotAcknowledged)
            fleet.switchboard.heal()
            fleet.run(20.0)
            self.assertEqual([node.replica.is_synced() for node in fleet.nodes], [True] * (count + newcomers))
            self.assertEqual(sorted(self.values(fleet, len(fleet.nodes) - 1)), [b"x", b"y"])

    def test_a_lost_memory_was_a_vote(self) -> None:
        """A node that lost its store is not synced if only nodes reply that may lack its records."""
        fleet = self.fleet(3)
        self.cut(fleet, 2)
        self.outcome(fleet, fleet.nodes[0].put(KEY, "a", b"x"))
        fleet.switchboard.heal()
        self.cut(fleet, 0)
        fleet.nodes[1].stop_silently()
        for _ in range(2):  # the same result after another restart
            former = fleet.stores[1]
            assert isinstance(former, MemoryStore)
            fleet.stores[1] = Replaced(former)
            fleet.restart(1, [2])
            for place in (1, 2):
                self.assertIs(self.values(fleet, place), Unavailable)
            fleet.nodes[1].stop_silently()
            fleet.stores[1].origin = "kept"
        fleet.restart(1, [2])
        fleet.switchboard.heal()
        fleet.run(10.0)
        self.assertEqual([self.values(fleet, place) for place in range(3)], [[b"x"]] * 3)

    def test_a_newcomer_and_a_lost_memory(self) -> None:
        """A new node that joins through a node without its store learns the members from it, but is not synced."""
        fleet = self.fleet(3)
        self.cut(fleet, 2, 3)
        fleet.nodes[2].stop_silently()
        former = fleet.stores[2]
        assert isinstance(former, MemoryStore)
        fleet.stores[2] = Replaced(former)
        fleet.restart(2, [0])
        self.joined(fleet, 1, 2)
        fleet.run(5.0)
        self.assertEqual([node.replica.is_synced() for node in fleet.nodes], [True, True, False, False])

    def test_a_door_that_shuts(self) -> None:
        """A new node waits for its only known peer if that peer failed before it sent the member list."""
        fleet = self.fleet(3)
        self.cut(fleet, 2, 3)
        self.joined(fleet, 1, 2)
        fleet.nodes[2].stop_silently()
        fleet.run(8.0)
        fleet.restart(2, [0])
        fleet.run(8.0)
        self.assertEqual([node.replica.is_synced() for node in fleet.nodes], [True, True, False, False])
        fleet.switchboard.heal()
        fleet.run(10.0)
        self.assertEqual([node.replica.is_synced() for node in fleet.nodes], [True] * 4)

    def test_the_unsure_hold_without_a_vote(self) -> None:
        """A replica that is not synced stores records without a vote.

        The writer waits briefly until the replica is synced and votes.
        """
        fleet = self.fleet(2)
        unsure = fleet.nodes[1].replica
        genuine, unsure.is_synced = unsure.is_synced, lambda: False
        owner = fleet.identity(0)
        record = Record(KEY, "a", owner.public, 2**40, "team", 60.0, b"x").sign(owner)
        self.assertEqual(unsure.answer_store(fleet.nodes[0].contact, [record.pack()]), [Outcome.UNSYNCED.value])
        self.assertEqual(unsure.get_held(KEY), [record])
        stored = fleet.nodes[0].put(KEY, "b", b"x")
        fleet.run(0.5)
        self.assertNoResult(stored)
        unsure.is_synced = genuine
        self.assertEqual(self.done(fleet, stored, 1.0), 2)
        unsure.is_synced = lambda: False
        self.assertEqual(self.done(fleet, fleet.nodes[0].put(KEY, "b", b"y", concern="one"), 0.1), 1)
        refused = self.outcome(fleet, fleet.nodes[0].put(KEY, "b", b"z"))
        self.assertIsInstance(refused, NotAcknowledged)
        self.assertEqual((refused.acknowledged, refused.needed), (1, 2))

    def test_a_later_record_at_the_unsure(self) -> None:
        """If a replica without a vote has a later record, this does not count as an acknowledgement of a write."""
        fleet = self.fleet(2)
        fleet.nodes[1].replica.is_synced = lambda: False
        first = fleet.nodes[0].put(KEY, "a", b"x")
        fleet.run(0.1)
        second = fleet.nodes[0].put(KEY, "a", b"y")
        self.assertIsInstance(self.outcome(fleet, first), NotAcknowledged)
        self.assertIsInstance(self.outcome(fleet, second), NotAcknowledged)

    def test_a_later_record_at_the_sure(self) -> None:
        """A write is acknowledged if a majority already stores a later version of the record."""
        fleet = self.fleet(3)
        fleet.switchboard.conditions = LinkConditions(delay_s=0.02, jitter_s=0.02, reorder=0.5)
        for _ in range(10):
            puts = [fleet.nodes[0].put(KEY, "a", b"%d" % number) for number in range(3)]
            self.assertEqual([type(self.outcome(fleet, put, 0.5)) for put in puts], [Stored] * 3)

    def test_who_comes_back_behind_a_cut(self) -> None:
        """A node that has not met its team does not report a key as empty because of the replies of a few members."""
        fleet = self.fleet(3)
        self.cut(fleet, 2)
        self.assertEqual(self.outcome(fleet, fleet.nodes[0].put(KEY, "a", b"x")), 2)
        fleet.nodes[1].stop_silently()
        self.cut(fleet, 1, 2)
        fleet.restart(1, [2])
        self.assertIs(type(self.outcome(fleet, fleet.nodes[1].get(KEY, "fast"))), Unavailable)


class StartTests(ConsistencyCase):
    def test_a_liar_makes_no_members_up(self) -> None:
        """A new node counts a member as absent only if several of the queried nodes list this member."""
        fleet = self.fleet(3)
        ghosts = [[[Identity(bytes([n]) * 32).public, "10.9.9.9", n], 0] for n in range(200, 204)]
        fleet.nodes[1].endpoint.expose("known", lambda peer: ghosts)
        self.joined(fleet, 1, 1)
        fleet.run(3.0)
        self.assertEqual(fleet.nodes[3].overlay.members.list_absent(), [])
        self.assertTrue(fleet.nodes[3].replica.is_synced())

    def test_a_new_team_all_at_once(self) -> None:
        """Nodes that start at the same time and know all addresses are synced within four seconds."""
        fleet = self.fleet(0)
        for place in range(5):
            fleet.nodes.append(fleet.make_node(place))
        for node in fleet.nodes:
            fleet.start_node(node, [fleet.address(place) for place in range(5)])
        fleet.run(4.0)
        self.assertEqual([node.replica.is_synced() for node in fleet.nodes], [True] * 5)

    def test_a_power_cut(self) -> None:
        """If all members but one restart from disk, the team is synced and can write within seconds."""
        fleet = self.fleet(5)
        self.outcome(fleet, fleet.nodes[0].put(KEY, "a", b"x"))
        for node in fleet.nodes:
            node.stop_silently()
        fleet.run(1.0)
        for place in range(4):
            fleet.restart(place, [(place + 1) % 4])
        fleet.run(5.0)
        self.assertEqual([node.replica.is_synced() for node in fleet.nodes[:4]], [True] * 4)
        self.assertEqual(self.values(fleet, 3), [b"x"])
        self.assertGreaterEqual(self.outcome(fleet, fleet.nodes[1].put(KEY, "a", b"y")), 3)
        fleet.nodes[4].stop()

    def test_after_the_longest_cut(self) -> None:
        """After the maximum duration of a partition half of a team continues alone, but not earlier."""
        fleet = self.fleet(2)
        fleet.nodes[1].stop_silently()
        fleet.run(MAX_ABSENT_S - 10.0)
        self.assertIs(self.values(fleet, 0), Unavailable)
        fleet.run(30.0)
        self.assertEqual(self.values(fleet, 0), [])
