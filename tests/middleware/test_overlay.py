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
from middleware.entangled.kademlia.distance import select_closest
from middleware.entangled.kademlia.member_table import MemberTable
from middleware.entangled.kademlia.overlay import (
    CONTACT_WAIT_STEP_S,
    CONTACT_WAIT_STEPS,
    MEMBERS_WAIT_STEP_S,
    MEMBERS_WAIT_STEPS,
    RECORD_INTERVAL_S,
    K,
    Overlay,
)
from middleware.entangled.network.network import Address
from middleware.entangled.network.switchboard import Switchboard
from middleware.entangled.record import hash_key
from middleware.entangled.wire.endpoint import Endpoint
from tests.fleet import TEAM_KEY, FleetCase


class OverlayTests(FleetCase):
    def test_who_has_not_met_its_team_has_no_majority(self) -> None:
        """A node that has not yet contacted its team has no majority, even if all members that it knows agree."""
        node = self.fleet(5).nodes[4]
        key, few = hash_key("a"), [node.contact, node.overlay.members.list_live()[0]]
        self.assertEqual(node.overlay.find_voters(key, few).size, 2)
        node.overlay.has_all_members = False
        voters = node.overlay.find_voters(key, few)
        named = {contact.node_id for contact in few}
        self.assertLess(voters.count_known(named), voters.majority)
        node.overlay.is_large = True
        self.assertEqual(node.overlay.find_voters(key, few).size, 2)

    def test_holders_are_the_closest_of_all(self) -> None:
        """In a large network every node finds the same k holders of a key, the closest ones, in order."""
        for n in (9, 20):
            fleet = self.fleet(n, seed=n)
            for key in map(hash_key, "abc"):
                truth = select_closest([node.contact for node in fleet.nodes], key, K)
                for node in fleet.nodes:
                    found = self.done(fleet, Deferred.fromCoroutine(node.overlay.lookup_replicas(key)), 0.5)
                    self.assertEqual(found, truth)
                    others = {c.node_id for c in truth} - {node.identity.node_id}
                    self.assertLessEqual(others, {c.node_id for c in node.overlay.find_possible_replicas(key)})

    def test_one_sign_of_life_is_as_good_as_many(self) -> None:
        """A repeated message from a contact changes nothing, unless the contact is suspected or has a new address."""
        fleet = self.fleet(3)
        overlay, other = fleet.nodes[0].overlay, fleet.nodes[1].contact
        seen: list[Contact] = []
        self.patch(overlay.table, "record_contact", lambda contact, now: seen.append(contact))
        fleet.run(2 * RECORD_INTERVAL_S)
        for _ in range(3):
            overlay.process_message(other)
        self.assertEqual(seen, [other])
        fleet.run(2 * RECORD_INTERVAL_S)
        overlay.process_message(other)
        self.assertEqual(seen, [other] * 2)
        overlay.mark_slow(other)
        overlay.process_message(other)
        moved = Contact(other.public, Address("10.0.0.9", 1))
        overlay.mark_authenticated(moved)
        self.assertEqual(seen, [other] * 3 + [moved])

    def test_the_found_are_kept_in_mind(self) -> None:
        """An offline contact in the routing table does not displace holders that a lookup has found."""
        fleet = self.fleet(14, seed=2)
        node, key = fleet.nodes[0], hash_key("a")
        node.overlay.has_all_members = False
        found = self.done(fleet, Deferred.fromCoroutine(node.overlay.lookup_replicas(key)), 0.5)
        node.overlay.has_all_members, node.overlay.members = False, MemberTable(node.identity.node_id)
        strangers = [Contact(bytes([n]) * 32, Address("10.0.0.9", n)) for n in range(1, 200)]
        for stranger in select_closest(strangers, key, 20):
            node.overlay.table.record_contact(stranger, fleet.clock.seconds())
        others = {c.node_id for c in found} - {node.identity.node_id}
        self.assertFalse(others <= {c.node_id for c in node.overlay.find_responsible(key)})
        self.assertLessEqual(others, {c.node_id for c in node.overlay.find_possible_replicas(key)})

    def test_the_silent_go(self) -> None:
        """A node that fails is removed from every table after a while; a node that stops is removed immediately."""
        fleet = self.fleet(4)
        fleet.nodes[3].stop_silently()
        fleet.nodes[2].stop()
        fleet.run(0.1)
        self.assertIsNone(fleet.nodes[0].overlay.table.get(fleet.nodes[2].identity.node_id))
        fleet.run(20.0)
        self.assertEqual([len(node.overlay.table) for node in fleet.nodes[:2]], [1, 1])

    def test_return_after_a_cut(self) -> None:
        """Nodes behind a partition of any duration rejoin soon after the partition ends."""
        for places, seconds, after in (((3,), 2.0, 6.0), ((3,), 6.0, 6.0), ((3,), 60.0, 6.0), ((0, 1), 3.0, 12.0)):
            fleet = self.fleet(4)
            fleet.switchboard.partition([fleet.address(place) for place in places])
            fleet.run(seconds)
            fleet.switchboard.heal()
            fleet.run(after)
            self.assertEqual([len(node.overlay.table) for node in fleet.nodes], [3] * 4, seconds)


class NewcomerTests(SynchronousTestCase):
    """Tests of a node without contacts, which sends no requests."""

    def setUp(self) -> None:
        self.clock = HeapClock()
        self.background = Background(self.clock)
        identity, address = Identity(bytes([1]) * 32), Address("10.0.0.1", 1)
        network = Switchboard(self.clock, random.Random(1)).make_network(*address)
        self.me = Contact(identity.public, address)
        endpoint = Endpoint(identity, TEAM_KEY, network, self.clock, random.Random(1))
        self.overlay = Overlay(lambda: self.me, endpoint, self.clock, self.background)
        self.overlay.has_found_neighbours = True
        self.addCleanup(self.background.stop)

    def meet(self) -> None:
        """Add one member of the team to the member table."""
        self.overlay.members.mark_alive(Contact(Identity(bytes([2]) * 32).public, Address("10.0.0.2", 2)), 0.0)

    def forget(self) -> None:
        """Remove all members."""
        self.overlay.members = MemberTable(self.me.node_id)
        self.overlay.has_all_members = self.overlay.is_large = False

    def knows_all(self) -> None:
        """Mark the member table as complete."""
        self.overlay.has_all_members = True

    def knows_many(self) -> None:
        """Mark the team as too large for a member table."""
        self.overlay.is_large = True

    def holders(self) -> Deferred[list[Contact]]:
        """Request the holders of a key."""
        return Deferred.fromCoroutine(self.overlay.lookup_replicas(hash_key("a")))

    def met(self) -> Deferred[None]:
        """Wait until the node has met the team."""
        return Deferred.fromCoroutine(self.overlay.wait_for_members())

    def look(self, work: Deferred[Any], news: Callable[[], None], step: float) -> bool:
        """Check that ``work`` waits. Then call ``news``, and return whether ``work`` ends at the next check."""
        self.clock.advance(3.5 * step)
        self.assertNoResult(work)
        news()
        self.clock.advance(step)
        return bool(work.called)

    def test_holders_wait_for_anybody(self) -> None:
        """A node without contacts stores nothing until it hears a member, knows that it is alone, or times out."""
        for news in (self.meet, self.knows_all):
            self.forget()
            self.assertTrue(self.look(self.holders(), news, CONTACT_WAIT_STEP_S))
            self.successResultOf(self.holders())
        self.forget()
        alone = self.holders()
        self.clock.advance((CONTACT_WAIT_STEPS - 0.5) * CONTACT_WAIT_STEP_S)
        self.assertNoResult(alone)
        self.clock.advance(CONTACT_WAIT_STEP_S)
        self.assertEqual(self.successResultOf(alone), [self.me])

    def test_meeting_waits_for_the_team(self) -> None:
        """``met`` waits for the complete member list, or the knowledge that the team is large.

        To hear one member is not enough.
        """
        for news in (self.knows_all, self.knows_many):
            self.forget()
            self.assertTrue(self.look(self.met(), news, MEMBERS_WAIT_STEP_S))
            self.successResultOf(self.met())
        self.forget()
        waiting = self.met()
        self.assertFalse(self.look(waiting, self.meet, MEMBERS_WAIT_STEP_S))
        self.clock.advance((MEMBERS_WAIT_STEPS - 5) * MEMBERS_WAIT_STEP_S)
        self.assertNoResult(waiting)
        self.clock.advance(MEMBERS_WAIT_STEP_S)
        self.successResultOf(waiting)
