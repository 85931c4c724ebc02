"""Tests of the overlay: the known members, and the holders of a key."""

from __future__ import annotations

import random
from collections.abc import Callable
from typing import Any

from twisted.internet.defer import Deferred
from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.background import Background
from middleware.entangled.clock import HeapClock
from middleware.entangled.contact import Contact
from middleware.entangled.identity import Identity
from middleware.entangled.kademlia.distance import closest
from middleware.entangled.kademlia.overlay import (
    FRESH,
    MEETING,
    MEETING_STEP,
    PLACING,
    PLACING_STEP,
    K,
    Overlay,
)
from middleware.entangled.kademlia.roster import Roster
from middleware.entangled.network.network import Address
from middleware.entangled.network.switchboard import Switchboard
from middleware.entangled.record import hashed_key
from middleware.entangled.wire.endpoint import Endpoint
from tests.fleet import TEAM, FleetCase


class OverlayTests(FleetCase):
    def test_who_has_not_met_its_team_has_no_majority(self) -> None:
        """A new node that has not met its team has no majority, even if all members that it knows agree."""
        node = self.fleet(5).nodes[4]
        key, few = hashed_key("a"), [node.contact, node.overlay.roster.live()[0]]
        self.assertEqual(node.overlay.voters(key, few).size, 2)
        node.overlay.is_whole = False
        voters = node.overlay.voters(key, few)
        named = {contact.node_id for contact in few}
        self.assertLess(voters.count_known(named), voters.majority)
        node.overlay.is_large = True
        self.assertEqual(node.overlay.voters(key, few).size, 2)

    def test_holders_are_the_closest_of_all(self) -> None:
        """In a large network every node finds the same k holders of a key, the closest ones, in order."""
        for n in (9, 20):
            fleet = self.fleet(n, seed=n)
            for key in map(hashed_key, "abc"):
                truth = closest([node.contact for node in fleet.nodes], key, K)
                for node in fleet.nodes:
                    found = self.done(fleet, Deferred.fromCoroutine(node.overlay.holders(key)), 0.5)
                    self.assertEqual(found, truth)
                    others = {c.node_id for c in truth} - {node.identity.node_id}
                    self.assertLessEqual(others, {c.node_id for c in node.overlay.keepers(key)})

    def test_one_sign_of_life_is_as_good_as_many(self) -> None:
        """A repeated message from a fresh contact changes nothing, unless the contact is doubted or has moved."""
        fleet = self.fleet(3)
        overlay, other = fleet.nodes[0].overlay, fleet.nodes[1].contact
        seen: list[Contact] = []
        self.patch(overlay.table, "saw", lambda contact, now: seen.append(contact))
        fleet.run(2 * FRESH)
        for _ in range(3):
            overlay.heard(other)
        self.assertEqual(seen, [other])
        fleet.run(2 * FRESH)
        overlay.heard(other)
        self.assertEqual(seen, [other] * 2)
        overlay.slow(other)
        overlay.heard(other)
        moved = Contact(other.public, Address("10.0.0.9", 1))
        overlay.proved(moved)
        self.assertEqual(seen, [other] * 3 + [moved])

    def test_the_found_are_kept_in_mind(self) -> None:
        """A contact in the routing table that is offline does not displace holders that a lookup found."""
        fleet = self.fleet(14, seed=2)
        node, key = fleet.nodes[0], hashed_key("a")
        node.overlay.is_whole = False
        found = self.done(fleet, Deferred.fromCoroutine(node.overlay.holders(key)), 0.5)
        node.overlay.is_whole, node.overlay.roster = False, Roster(node.identity.node_id)
        strangers = [Contact(bytes([n]) * 32, Address("10.0.0.9", n)) for n in range(1, 200)]
        for stranger in closest(strangers, key, 20):
            node.overlay.table.saw(stranger, fleet.clock.seconds())
        others = {c.node_id for c in found} - {node.identity.node_id}
        self.assertFalse(others <= {c.node_id for c in node.overlay.responsible(key)})
        self.assertLessEqual(others, {c.node_id for c in node.overlay.keepers(key)})

    def test_the_silent_go(self) -> None:
        """A node that fails is removed from every table after a while, a node that stops at once."""
        fleet = self.fleet(4)
        fleet.nodes[3].vanish()
        fleet.nodes[2].stop()
        fleet.run(0.1)
        self.assertIsNone(fleet.nodes[0].overlay.table.get(fleet.nodes[2].identity.node_id))
        fleet.run(20.0)
        self.assertEqual([len(node.overlay.table) for node in fleet.nodes[:2]], [1, 1])

    def test_return_after_a_cut(self) -> None:
        """Nodes behind a partition of any length rejoin soon after it heals."""
        for places, seconds, after in (((3,), 2.0, 6.0), ((3,), 6.0, 6.0), ((3,), 60.0, 6.0), ((0, 1), 3.0, 12.0)):
            fleet = self.fleet(4)
            fleet.board.partition([fleet.address(place) for place in places])
            fleet.run(seconds)
            fleet.board.heal()
            fleet.run(after)
            self.assertEqual([len(node.overlay.table) for node in fleet.nodes], [3] * 4, seconds)


class NewcomerTests(SynchronousTestCase):
    """A node without contacts, which sends no requests."""

    def setUp(self) -> None:
        self.clock = HeapClock()
        self.chores = Background(self.clock)
        identity, address = Identity(bytes([1]) * 32), Address("10.0.0.1", 1)
        network = Switchboard(self.clock, random.Random(1)).network(*address)
        self.me = Contact(identity.public, address)
        endpoint = Endpoint(identity, TEAM, network, self.clock, random.Random(1))
        self.overlay = Overlay(lambda: self.me, endpoint, self.clock, self.chores)
        self.overlay.is_placed = True
        self.addCleanup(self.chores.stop)

    def meet(self) -> None:
        """Add one member of the team to the roster."""
        self.overlay.roster.heard(Contact(Identity(bytes([2]) * 32).public, Address("10.0.0.2", 2)), 0.0)

    def forget(self) -> None:
        """Remove all members."""
        self.overlay.roster = Roster(self.me.node_id)
        self.overlay.is_whole = self.overlay.is_large = False

    def knows_all(self) -> None:
        """Mark the roster as complete."""
        self.overlay.is_whole = True

    def knows_many(self) -> None:
        """Mark the team as too large for a roster."""
        self.overlay.is_large = True

    def holders(self) -> Deferred[list[Contact]]:
        """Request the holders of a key."""
        return Deferred.fromCoroutine(self.overlay.holders(hashed_key("a")))

    def met(self) -> Deferred[None]:
        """Wait for the team."""
        return Deferred.fromCoroutine(self.overlay.met())

    def look(self, work: Deferred[Any], news: Callable[[], None], step: float) -> bool:
        """Return whether ``work``, which waits, ends at the first check after ``news``."""
        self.clock.advance(3.5 * step)
        self.assertNoResult(work)
        news()
        self.clock.advance(step)
        return bool(work.called)

    def test_holders_wait_for_anybody(self) -> None:
        """A node without contacts delays a store until it hears a member, knows that it is alone, or times out."""
        for news in (self.meet, self.knows_all):
            self.forget()
            self.assertTrue(self.look(self.holders(), news, PLACING_STEP))
            self.successResultOf(self.holders())
        self.forget()
        alone = self.holders()
        self.clock.advance((PLACING - 0.5) * PLACING_STEP)
        self.assertNoResult(alone)
        self.clock.advance(PLACING_STEP)
        self.assertEqual(self.successResultOf(alone), [self.me])

    def test_meeting_waits_for_the_team(self) -> None:
        """``met`` waits until the team is completely known or known to be large; one member is not enough."""
        for news in (self.knows_all, self.knows_many):
            self.forget()
            self.assertTrue(self.look(self.met(), news, MEETING_STEP))
            self.successResultOf(self.met())
        self.forget()
        waiting = self.met()
        self.assertFalse(self.look(waiting, self.meet, MEETING_STEP))
        self.clock.advance((MEETING - 5) * MEETING_STEP)
        self.assertNoResult(waiting)
        self.clock.advance(MEETING_STEP)
        self.successResultOf(waiting)
