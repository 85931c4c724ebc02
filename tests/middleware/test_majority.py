"""Tests that two majorities share a member, whoever joins, comes back empty or is cut off."""

from __future__ import annotations

from typing import Any

from twisted.internet.defer import Deferred

from middleware.entangled.data.memory import MemoryStore
from middleware.entangled.errors import NotAcknowledged, Unavailable
from middleware.entangled.identity import Identity
from middleware.entangled.kademlia.roster import COUNTED_S, STRUCK_S
from middleware.entangled.network.switchboard import Weather
from middleware.entangled.record import Record, hashed_key
from middleware.entangled.replication.owner import Stored
from middleware.entangled.replication.store_reply import Outcome
from tests.fleet import Fleet, FleetCase

KEY = hashed_key("colour")


class Replaced(MemoryStore):
    """A store that was made anew because its file was rotten; it has the notes of the old one."""

    origin = "replaced"

    def __init__(self, former: MemoryStore) -> None:
        super().__init__()
        self._notes = dict(former._notes)


class MajorityCase(FleetCase):
    def cut(self, fleet: Fleet, *places: int) -> None:
        fleet.board.partition([fleet.address(place) for place in places])

    def joined(self, fleet: Fleet, count: int, known: int) -> None:
        for _ in range(count):
            place = len(fleet.nodes)
            fleet.nodes.append(fleet.made(place))
            fleet.enter(fleet.nodes[place], [fleet.address(known)])
            fleet.run(0.3)

    def outcome(self, fleet: Fleet, work: Deferred[Any], within: float = 5.0) -> Any:
        """What came of ``work``: its result, or its exception."""
        results: list[Any] = []
        work.addErrback(lambda failure: failure.value).addCallback(results.append)
        fleet.run(within)
        return results[0] if results else None

    def values(self, fleet: Fleet, place: int) -> Any:
        """What a majority read at a node gives: values, or why there are none."""
        found = self.outcome(fleet, fleet.nodes[place].get(KEY))
        return [record.value for record in found] if isinstance(found, list) else type(found)


class CutTests(MajorityCase):
    """Few behind a cut, with newcomers of their own, against the many."""

    def test_newcomers_make_no_majority_of_a_minority(self) -> None:
        """However many join on the smaller side of a cut, nothing is read or written there by majority."""
        for count, small, newcomers, wait in ((3, (2,), 2, 3.0), (5, (3, 4), 3, 12.0), (4, (2, 3), 3, 0.0)):
            fleet = self.fleet(count)
            self.cut(fleet, *small, *range(count, count + newcomers))
            fleet.run(wait)  # whether the many are known as absent yet, or not
            has_majority = 2 * len(small) < count
            stored = self.outcome(fleet, fleet.nodes[0].put(KEY, "a", b"x"))
            self.assertEqual(type(stored) is NotAcknowledged, not has_majority)
            self.joined(fleet, newcomers, small[0])
            for _ in range(int((STRUCK_S + 20.0) / 11.0)):
                self.assertIs(self.values(fleet, small[0]), Unavailable)
                self.assertIs(self.values(fleet, len(fleet.nodes) - 1), Unavailable)
                fleet.run(1.0)
            written = self.outcome(fleet, fleet.nodes[-1].put(KEY, "b", b"y"))
            self.assertIs(type(written), NotAcknowledged)
            fleet.board.heal()
            fleet.run(20.0)
            self.assertEqual([node.replica.is_sure() for node in fleet.nodes], [True] * (count + newcomers))
            self.assertEqual(sorted(self.values(fleet, len(fleet.nodes) - 1)), [b"x", b"y"])

    def test_a_lost_memory_was_a_vote(self) -> None:
        """A node whose file rotted away is not sure while only those answer who may have missed what it held."""
        fleet = self.fleet(3)
        self.cut(fleet, 2)
        self.outcome(fleet, fleet.nodes[0].put(KEY, "a", b"x"))
        fleet.board.heal()
        self.cut(fleet, 0)
        fleet.nodes[1].vanish()
        for _ in range(2):  # nor in its next life
            former = fleet.stores[1]
            assert isinstance(former, MemoryStore)
            fleet.stores[1] = Replaced(former)
            fleet.restart(1, [2])
            for place in (1, 2):
                self.assertIs(self.values(fleet, place), Unavailable)
            fleet.nodes[1].vanish()
            fleet.stores[1].origin = "kept"
        fleet.restart(1, [2])
        fleet.board.heal()
        fleet.run(10.0)
        self.assertEqual([self.values(fleet, place) for place in range(3)], [[b"x"]] * 3)

    def test_a_newcomer_and_a_lost_memory(self) -> None:
        """Whoever enters by a node that lost its records hears from it who else there was, and is not sure without."""
        fleet = self.fleet(3)
        self.cut(fleet, 2, 3)
        fleet.nodes[2].vanish()
        former = fleet.stores[2]
        assert isinstance(former, MemoryStore)
        fleet.stores[2] = Replaced(former)
        fleet.restart(2, [0])
        self.joined(fleet, 1, 2)
        fleet.run(5.0)
        self.assertEqual([node.replica.is_sure() for node in fleet.nodes], [True, True, False, False])

    def test_a_door_that_shuts(self) -> None:
        """A newcomer that did not hear who is known from the only one it met waits for that one, and for its word."""
        fleet = self.fleet(3)
        self.cut(fleet, 2, 3)
        self.joined(fleet, 1, 2)
        fleet.nodes[2].vanish()
        fleet.run(8.0)
        fleet.restart(2, [0])
        fleet.run(8.0)
        self.assertEqual([node.replica.is_sure() for node in fleet.nodes], [True, True, False, False])
        fleet.board.heal()
        fleet.run(10.0)
        self.assertEqual([node.replica.is_sure() for node in fleet.nodes], [True] * 4)

    def test_the_unsure_hold_without_a_vote(self) -> None:
        """A replica that is not sure keeps what is stored at it, and the writer waits for its vote a little."""
        fleet = self.fleet(2)
        unsure = fleet.nodes[1].replica
        genuine, unsure.is_sure = unsure.is_sure, lambda: False
        owner = fleet.identity(0)
        record = Record(KEY, "a", owner.public, 2**40, "team", 60.0, b"x").signed(owner)
        self.assertEqual(unsure.answer_store(fleet.nodes[0].contact, [record.packed()]), [Outcome.UNSYNCED.value])
        self.assertEqual(unsure.held(KEY), [record])
        stored = fleet.nodes[0].put(KEY, "b", b"x")
        fleet.run(0.5)
        self.assertNoResult(stored)
        unsure.is_sure = genuine
        self.assertEqual(self.done(fleet, stored, 1.0), 2)
        unsure.is_sure = lambda: False
        self.assertEqual(self.done(fleet, fleet.nodes[0].put(KEY, "b", b"y", concern="one"), 0.1), 1)
        refused = self.outcome(fleet, fleet.nodes[0].put(KEY, "b", b"z"))
        self.assertIsInstance(refused, NotAcknowledged)
        self.assertEqual((refused.acknowledged, refused.needed), (1, 2))

    def test_a_later_record_at_the_unsure(self) -> None:
        """A write is not acknowledged because a replica without a vote has the one after it."""
        fleet = self.fleet(2)
        fleet.nodes[1].replica.is_sure = lambda: False
        first = fleet.nodes[0].put(KEY, "a", b"x")
        fleet.run(0.1)
        second = fleet.nodes[0].put(KEY, "a", b"y")
        self.assertIsInstance(self.outcome(fleet, first), NotAcknowledged)
        self.assertIsInstance(self.outcome(fleet, second), NotAcknowledged)

    def test_a_later_record_at_the_sure(self) -> None:
        """A write is acknowledged where a majority has the one after it."""
        fleet = self.fleet(3)
        fleet.board.weather = Weather(delay_s=0.02, jitter_s=0.02, reorder=0.5)
        for _ in range(10):
            puts = [fleet.nodes[0].put(KEY, "a", b"%d" % number) for number in range(3)]
            self.assertEqual([type(self.outcome(fleet, put, 0.5)) for put in puts], [Stored] * 3)

    def test_who_comes_back_behind_a_cut(self) -> None:
        """A node that has yet to meet its team does not take the few that it meets for all, and deny what is there."""
        fleet = self.fleet(3)
        self.cut(fleet, 2)
        self.assertEqual(self.outcome(fleet, fleet.nodes[0].put(KEY, "a", b"x")), 2)
        fleet.nodes[1].vanish()
        self.cut(fleet, 1, 2)
        fleet.restart(1, [2])
        self.assertIs(type(self.outcome(fleet, fleet.nodes[1].get(KEY, "fast"))), Unavailable)


class StartTests(MajorityCase):
    def test_a_liar_makes_no_members_up(self) -> None:
        """A newcomer counts nobody as absent whom only one of those that it asks names."""
        fleet = self.fleet(3)
        ghosts = [[[Identity(bytes([n]) * 32).public, "10.9.9.9", n], 0] for n in range(200, 204)]
        fleet.nodes[1].endpoint.expose("known", lambda peer: ghosts)
        self.joined(fleet, 1, 1)
        fleet.run(3.0)
        self.assertEqual(fleet.nodes[3].overlay.roster.absent(), [])
        self.assertTrue(fleet.nodes[3].replica.is_sure())

    def test_a_new_team_all_at_once(self) -> None:
        """Nodes that start at the same moment, each told of all others, are all sure in two seconds."""
        fleet = self.fleet(0)
        for place in range(5):
            fleet.nodes.append(fleet.made(place))
        for node in fleet.nodes:
            fleet.enter(node, [fleet.address(place) for place in range(5)])
        fleet.run(4.0)
        self.assertEqual([node.replica.is_sure() for node in fleet.nodes], [True] * 5)

    def test_a_power_cut(self) -> None:
        """A team that comes back from its disks, all but one of it, is sure and writes again in a few seconds."""
        fleet = self.fleet(5)
        self.outcome(fleet, fleet.nodes[0].put(KEY, "a", b"x"))
        for node in fleet.nodes:
            node.vanish()
        fleet.run(1.0)
        for place in range(4):
            fleet.restart(place, [(place + 1) % 4])
        fleet.run(5.0)
        self.assertEqual([node.replica.is_sure() for node in fleet.nodes[:4]], [True] * 4)
        self.assertEqual(self.values(fleet, 3), [b"x"])
        self.assertGreaterEqual(self.outcome(fleet, fleet.nodes[1].put(KEY, "a", b"y")), 3)
        fleet.nodes[4].stop()

    def test_after_the_longest_cut(self) -> None:
        """Half of a team goes on alone when no cut lasts so long, and not before."""
        fleet = self.fleet(2)
        fleet.nodes[1].vanish()
        fleet.run(COUNTED_S - 10.0)
        self.assertIs(self.values(fleet, 0), Unavailable)
        fleet.run(30.0)
        self.assertEqual(self.values(fleet, 0), [])
