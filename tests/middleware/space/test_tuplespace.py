"""Tests of tuple spaces on whole nodes."""

from __future__ import annotations

import gc
from collections.abc import Callable, Sequence
from typing import Any

from twisted.internet.defer import CancelledError, Deferred

from middleware.entangled.errors import NoAnswer, NotRunning, Refused, TooLarge
from middleware.entangled.network.switchboard import LinkConditions
from middleware.entangled.node import EntangledNode
from middleware.entangled.space.taker import Claim, ClaimLost
from middleware.entangled.space.template import ANY, BadTuple, where
from middleware.entangled.space.tuple_record import StoredTuple, parse_record
from middleware.entangled.space.tuplespace import NoTuple, TupleSpace
from tests.fleet import EntangledTeam, FleetCase

DELAY = LinkConditions(delay_s=0.005, jitter_s=0.002)


class SpaceCase(FleetCase):
    """A test case with one space on each node of a simulated team."""

    made: list[TupleSpace]

    def spaces(self, n: int, weather: LinkConditions = DELAY, seed: int = 1) -> tuple[EntangledTeam, list[TupleSpace]]:
        """Return a simulated team and a space on each node; the spaces are stopped before the team is stopped."""
        fleet = self.fleet(n, seed, weather)
        spaces = [TupleSpace(node, fleet.clock, fleet.make_life_rng(place)) for place, node in enumerate(fleet.nodes)]
        self.made = spaces
        return fleet, spaces

    def setUp(self) -> None:
        super().setUp()
        self.made = []

    def tearDown(self) -> None:
        for space in self.made:
            space.stop()
        super().tearDown()

    def posted(self, fleet: EntangledTeam) -> list[StoredTuple]:
        """Return every tuple that at least one node stores, without duplicates."""
        said = [parse_record(record) for node in fleet.nodes for record in node.store.records()]
        return list({one.tuple_id: one for one in said if isinstance(one, StoredTuple)}.values())

    def called_up(self, node: EntangledNode, answer: Callable[..., object]) -> None:
        """Let ``node`` give this reply to the request to join a council."""
        node.take_acceptor.load()  # otherwise the acceptor would register its own method later
        node.endpoint.expose("decree.enrol", answer)

    def moment(self, fleet: EntangledTeam, work: Deferred[Any]) -> list[float]:
        """Return a list that will contain the time at which ``work`` fires."""
        moments: list[float] = []

        def fired(result: object) -> object:
            moments.append(fleet.clock.seconds())
            return result

        work.addCallback(fired)
        return moments


class TupleSpaceTests(SpaceCase):
    def test_put_read_and_get(self) -> None:
        """All nodes can read a tuple by a template; after one node took the tuple, no node can read it."""
        fleet, (a, b, c) = self.spaces(3)
        for number in (2, 1, 3):
            self.done(fleet, a.put(("job", number, None)), 1.0)
        for space in (a, b, b):
            self.assertEqual(self.done(fleet, space.read(("job", 1, ANY))), ("job", 1, None))
            self.assertEqual(self.done(fleet, space.read_if_exists((str, 1, None))), ("job", 1, None))
        self.assertIsNone(self.done(fleet, a.read_if_exists(("job", float, ANY))))
        found = self.done(fleet, c.read_all(("job", where(">=", 2), ANY)))
        self.assertEqual(sorted(found, key=str), [("job", 2, None), ("job", 3, None)])
        self.assertEqual(self.done(fleet, b.get(("job", where("<", 2), ANY))), ("job", 1, None))
        for space in (a, b, c):
            self.assertIsNone(self.done(fleet, space.get_if_exists(("job", 1, ANY))))
            self.assertEqual(len(self.done(fleet, space.read_all(("job", ANY, ANY)))), 2)

    def test_equal_tuples_are_several(self) -> None:
        """Each of several equal tuples is taken once; tuples of another space or length do not match."""
        fleet, (a, b, _) = self.spaces(3)
        for space in (a, a, b):
            self.done(fleet, space.put(("same",)), 1.0)
        other = TupleSpace(fleet.nodes[1], fleet.clock, fleet.make_life_rng(9), name="other")
        self.made.append(other)
        self.assertIsNone(self.done(fleet, other.read_if_exists(("same",))))
        self.assertIsNone(self.done(fleet, b.read_if_exists(("same", ANY))))
        self.assertEqual(self.done(fleet, b.get_many(("same",), 5)), [("same",)] * 3)

    def test_stopped_while_several_are_confirmed(self) -> None:
        """If a space stops before its takes are confirmed, the waiting call fails, and no unhandled error is logged."""
        fleet, (a, b, _) = self.spaces(3)
        for _ in range(3):
            self.done(fleet, a.put(("same",)), 1.0)
        decide = b._taker.decide

        async def cut_off(claims: Sequence[Claim]) -> list[bool]:
            fleet.switchboard.conditions = LinkConditions(loss=1.0)
            return await decide(claims)

        self.patch(b._taker, "decide", cut_off)
        taking = b.get_many(("same",), 3)
        fleet.run(0.2)  # the confirm requests are in flight
        b.stop()
        fleet.run(30.0)
        self.failureResultOf(taking, NotRunning)
        gc.collect()
        self.assertEqual(self.flushLoggedErrors(), [])

    def test_wakes_who_waits(self) -> None:
        """A blocked read and a blocked get return within a second of the put; each tuple ends only one get."""
        fleet, spaces = self.spaces(6)
        reading = self.moment(fleet, spaces[1].read(("go", int)))
        gets = [space.get(("go", int)) for space in spaces[2:5]]
        got = [self.moment(fleet, get) for get in gets]
        fleet.run(7.3)
        began = fleet.clock.seconds()
        spaces[0].put(("go", 1))
        fleet.run(1.0)
        self.assertLess(reading[0] - began, 0.2)
        self.assertEqual([len(moments) for moments in got].count(1), 1)
        for number in (2, 3):
            spaces[5].put(("go", number))
            fleet.run(1.0)
            self.assertEqual([len(moments) for moments in got].count(1), number)

    def test_wait_survives_the_nodes_that_held_it(self) -> None:
        """A blocked read returns after the next put although most of the watched replicas have failed."""
        fleet, spaces = self.spaces(6)
        waiting = self.moment(fleet, spaces[0].read(("go",)))
        fleet.run(1.0)
        for place in (2, 3, 4):
            fleet.switchboard.kill(fleet.address(place))
            fleet.nodes[place].stop_silently()
        fleet.run(12.0)
        began = fleet.clock.seconds()
        # Half of the members have failed, so the put cannot be confirmed; the blocked read still returns.
        spaces[5].put(("go",)).addErrback(lambda failure: failure.trap(NoAnswer))
        fleet.run(1.5)
        self.assertLess(waiting[0] - began, 1.0)

    def test_a_council_is_whole(self) -> None:
        """A put waits for silent members, because a smaller council would tolerate no failure.

        If these members stay silent, the put fails.
        """
        fleet, (a, *_) = self.spaces(4)
        for node in fleet.nodes[1:]:
            self.called_up(node, lambda peer: Deferred())
        put = a.put(("job",))
        fleet.run(4.0)
        self.assertNoResult(put)
        self.assertEqual(self.posted(fleet), [])
        for node in fleet.nodes[1:]:
            self.called_up(node, node.take_acceptor.answer_enrol)
        self.done(fleet, put)
        self.assertEqual([len(one.council) for one in self.posted(fleet)], [3])
        for node in fleet.nodes[1:]:
            self.called_up(node, lambda peer: Deferred())
        never = a.put(("job", 2))
        fleet.run(20.0)
        self.failureResultOf(never, NoAnswer)
        self.assertEqual(len(self.posted(fleet)), 1)

    def test_a_council_without_those_who_refuse(self) -> None:
        """A put does not wait for nodes that refuse to be council members; the council is as large as possible."""
        fleet, (a, *_) = self.spaces(3)

        def refuse(peer: object) -> bytes:
            raise Refused("not here")

        self.called_up(fleet.nodes[1], refuse)
        self.done(fleet, a.put(("job",)), 1.0)
        self.assertEqual([len(one.council) for one in self.posted(fleet)], [2])

    def test_timeout(self) -> None:
        """A blocking call raises ``NoTuple`` after its timeout."""
        fleet, (a, b, _) = self.spaces(3)
        calls = [a.get(("none",), timeout=0.5), b.read(("none",), timeout=0.5), b.claim(("none",), timeout=0.5)]
        fleet.run(0.6)
        for call in calls:
            self.failureResultOf(call, NoTuple)

    def test_cancel(self) -> None:
        """A cancelled get takes no tuple; the next caller gets the next tuple."""
        fleet, (a, b, c) = self.spaces(3)
        get = a.get(("job",))
        fleet.run(1.0)
        get.cancel()
        self.failureResultOf(get, CancelledError)
        self.done(fleet, b.put(("job",)), 1.0)
        self.assertEqual(self.done(fleet, c.get_if_exists(("job",))), ("job",))

    def test_cancelled_too_late(self) -> None:
        """If a get is cancelled while its take is being confirmed, the tuple is put back."""
        fleet, (a, b, c) = self.spaces(3)
        for pause in (0.005, 0.012, 0.02, 0.03, 0.04, 0.05):
            self.done(fleet, b.put(("job", pause)), 1.0)
            get = a.get(("job", pause))
            fleet.run(pause)
            get.addErrback(lambda failure: failure.trap(CancelledError))
            get.cancel()
            fleet.run(4.0)
            if not isinstance(self.successResultOf(get), tuple):
                self.assertEqual(self.done(fleet, c.get(("job", pause), timeout=4.0)), ("job", pause), pause)

    def test_ttl(self) -> None:
        """A tuple with a TTL exists until its TTL ends."""
        fleet, (a, b, _) = self.spaces(3)
        self.done(fleet, a.put(("short",), ttl=5.0), 1.0)
        self.assertEqual(self.done(fleet, b.read_if_exists(("short",)), 1.0), ("short",))
        fleet.run(4.0)
        self.assertIsNone(self.done(fleet, b.read_if_exists(("short",)), 1.0))
        self.assertIsNone(self.done(fleet, b.get_if_exists(("short",)), 1.0))

    def test_tuples_that_nobody_can_take_do_not_keep_the_others(self) -> None:
        """If the council of a tuple has lost its majority, ``get`` skips this tuple and takes other tuples."""
        fleet, spaces = self.spaces(8)
        for number in range(4):
            self.done(fleet, spaces[0].put(("stuck", number)), 0.5)
        [council] = {one.council for one in self.posted(fleet)}
        dead = [n for n, node in enumerate(fleet.nodes) if any(m.contact == node.contact for m in council)][:2]
        for place in dead:
            spaces[place].stop()
            fleet.kill(place)
        fleet.run(20.0)
        living = [space for place, space in enumerate(spaces) if place not in dead]
        for number in range(4):
            self.done(fleet, living[0].put(("good", number)))
        for space in living[1:5]:
            self.assertEqual(self.done(fleet, space.get((str, int)), 20.0)[0], "good")

    def test_slots_are_used_again(self) -> None:
        """Slots of taken tuples are used again, which limits the number of slots."""
        fleet, (a, b, _) = self.spaces(3)
        for number in range(150):
            self.done(fleet, a.put(("n", number)), 0.1)
            self.assertEqual(self.done(fleet, b.get(("n", number)), 0.2), ("n", number))
        self.assertLess(len(fleet.stores[0]), 150)
        fleet.run(95.0)
        self.assertEqual(self.done(fleet, a.read_all(("n", ANY))), [])

    def test_single_node(self) -> None:
        """A single node can use a space without other nodes."""
        fleet, (a,) = self.spaces(1)
        self.done(fleet, a.put(("x",)))
        self.assertEqual(self.done(fleet, a.get(("x",))), ("x",))

    def test_wrong_use(self) -> None:
        """An invalid tuple raises immediately, and a stopped space raises ``NotRunning``."""
        fleet, (a, b) = self.spaces(2)
        fleet.run(1.0)
        for wrong in ([], [object()], "text"):
            for call in (a.put, a.get, a.read, a.get_if_exists, a.read_if_exists, a.read_all, a.claim):
                self.assertRaises(BadTuple, call, wrong)
        self.assertRaises(TooLarge, a.put, ["x" * 700])
        waiting = b.get(("x",))
        b.stop()
        b.stop()
        self.failureResultOf(waiting, NotRunning)
        self.failureResultOf(b.put(("x",)), NotRunning)
        self.failureResultOf(b.get(("x",)), NotRunning)


class ClaimTests(SpaceCase):
    def _claimed(self, fleet: EntangledTeam, space: TupleSpace, lease: float = 2.0) -> Claim:
        claim = self.done(fleet, space.claim(("job", ANY), lease), 1.0)
        self.assertIsInstance(claim, Claim)
        return claim

    def test_confirm(self) -> None:
        """Other nodes cannot take a claimed tuple; after the confirmation it is taken."""
        fleet, (a, b, c) = self.spaces(3)
        self.done(fleet, a.put(("job", 1)), 1.0)
        claim = self._claimed(fleet, b, lease=10.0)
        self.assertEqual(claim.fields, ("job", 1))
        self.assertIsNone(self.done(fleet, c.get_if_exists(("job", ANY)), 1.0))
        self.assertEqual(self.done(fleet, c.read_if_exists(("job", ANY)), 1.0), ("job", 1))
        self.assertEqual(self.done(fleet, claim.confirm(), 1.0), ("job", 1))
        self.assertIsNone(self.done(fleet, c.read_if_exists(("job", ANY)), 1.0))
        self.failureResultOf(claim.confirm(), ClaimLost)

    def test_a_dead_taker_gives_back(self) -> None:
        """The claim of a failed taker ends with the lease of the claim, even if the publisher has failed, too."""
        fleet, spaces = self.spaces(6)
        self.done(fleet, spaces[1].put(("job", 1)), 1.0)
        self._claimed(fleet, spaces[2], lease=3.0)
        for place in (1, 2):
            spaces[place].stop()
            fleet.nodes[place].stop_silently()
        got = self.moment(fleet, spaces[3].get(("job", int)))
        fleet.run(5.5)
        self.assertEqual(len(got), 1)

    def test_release(self) -> None:
        """When a claim is released, the tuple is available immediately."""
        fleet, (a, b, c) = self.spaces(3)
        self.done(fleet, a.put(("job", 1)), 1.0)
        claim = self._claimed(fleet, b, lease=60.0)
        waiting = c.get(("job", ANY))
        fleet.run(1.0)
        self.assertNoResult(waiting)
        claim.release()
        claim.release()
        self.assertEqual(self.done(fleet, waiting, 1.0), ("job", 1))

    def test_get_behind_another_call_of_the_same_node(self) -> None:
        """A blocked get takes a tuple after another call of the same node has failed to take it."""
        fleet, (a, b, c) = self.spaces(3)
        b.read(("bell", int)).addErrback(lambda failure: failure.trap(NotRunning))  # keeps the cache of node b open
        self.done(fleet, a.put(("job", 1)), 1.0)
        self._claimed(fleet, c, lease=4.0)
        at_once, waiting = b.get_if_exists(("job", ANY)), b.get(("job", ANY))
        self.assertIsNone(self.done(fleet, at_once, 3.0))
        self.assertEqual(self.done(fleet, waiting, 5.0), ("job", 1))

    def test_renew(self) -> None:
        """A renewed claim lasts longer than its first lease; a confirmed claim cannot be renewed."""
        fleet, (a, b, c) = self.spaces(3)
        self.done(fleet, a.put(("job", 1)), 1.0)
        claim = self._claimed(fleet, b)
        for _ in range(4):
            self.assertIsNone(self.done(fleet, claim.renew(), 1.0))
        self.assertIsNone(self.done(fleet, c.get_if_exists(("job", ANY)), 0.5))
        self.assertEqual(self.done(fleet, claim.confirm(), 1.0), ("job", 1))
        self.failureResultOf(claim.renew(), ClaimLost)

    def test_late_confirm(self) -> None:
        """A late confirm succeeds if no other node has taken the tuple, otherwise it raises ``ClaimLost``.

        It is late if the lease of the claim has ended.
        """
        fleet, (a, b, c) = self.spaces(3)
        self.done(fleet, a.put(("job", 1)), 1.0)
        claim = self._claimed(fleet, b, lease=1.0)
        fleet.run(3.0)
        self.assertEqual(self.done(fleet, claim.confirm(), 1.0), ("job", 1))
        self.done(fleet, a.put(("job", 2)), 1.0)
        claim = self._claimed(fleet, b, lease=1.0)
        fleet.run(1.0)
        self.assertEqual(self.done(fleet, c.get(("job", ANY)), 2.0), ("job", 2))
        confirm = claim.confirm()
        fleet.run(2.0)
        self.failureResultOf(confirm, ClaimLost)


class RestartTests(SpaceCase):
    def test_a_restarted_member_knows_what_it_accepted(self) -> None:
        """A taken tuple stays taken after a restart of all members with their stores."""
        fleet, spaces = self.spaces(3)
        self.done(fleet, spaces[0].put(("job", 1)), 1.0)
        self.done(fleet, spaces[1].get(("job", ANY)), 1.0)
        lives = [node.take_acceptor.incarnation for node in fleet.nodes]
        for space, node in zip(spaces, fleet.nodes, strict=True):
            space.stop()
            node.stop_silently()
        for place in range(3):
            fleet.restart(place, [other for other in range(3) if other != place])
        fleet.run(5.0)
        self.made = [TupleSpace(node, fleet.clock, fleet.make_life_rng(7)) for node in fleet.nodes]
        self.assertEqual([node.take_acceptor.incarnation for node in fleet.nodes], lives)
        for space in self.made:
            self.assertIsNone(self.done(fleet, space.get_if_exists(("job", ANY)), 2.0))
        self.done(fleet, self.made[0].put(("job", 2)), 1.0)
        self.assertEqual(self.done(fleet, self.made[2].get(("job", ANY)), 2.0), ("job", 2))
