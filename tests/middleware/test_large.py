"""Tests of networks that are too large for a member table, here with a limit of twelve members."""

from __future__ import annotations

import random
from collections import Counter
from typing import Any

from twisted.internet.defer import Deferred
from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.contact import Contact
from middleware.entangled.identity import ID_BYTES
from middleware.entangled.kademlia import member_table, membership, overlay
from middleware.entangled.kademlia.distance import select_closest
from middleware.entangled.kademlia.liveness_probe import (
    INITIAL_SILENCE_S,
    MAX_SILENCE_S,
    MIN_SILENCE_S,
    NEIGHBOUR_SILENCE_S,
    SESSION_S,
    TARGET_FAILURES,
    ProbeInterval,
)
from middleware.entangled.kademlia.membership import LARGE_REPORT_S
from middleware.entangled.kademlia.overlay import MAX_HEDGE_S, K
from middleware.entangled.network.network import Address
from middleware.entangled.network.switchboard import PERFECT, LinkConditions, SwitchboardNetwork
from middleware.entangled.node import EntangledNode
from middleware.entangled.record import Record, hash_key
from middleware.entangled.wire.congestion import INITIAL_TIMEOUT_S
from middleware.entangled.wire.session import INIT
from tests.fleet import EntangledTeam, FleetCase

MANY = 12


class LargeTests(FleetCase):
    def setUp(self) -> None:
        super().setUp()
        for module in (membership, overlay, member_table):
            self.patch(module, "MAX_MEMBERS", MANY)

    def large(self, n: int = 24, weather: LinkConditions = PERFECT) -> EntangledTeam:
        fleet = self.fleet(n, seed=3, weather=weather)
        fleet.run(20.0)
        self.assertTrue(all(node.overlay.is_large for node in fleet.nodes))
        return fleet

    def pings(self, node: EntangledNode) -> Counter[bytes]:
        """Return a counter of later pings of a node by target."""
        asked: Counter[bytes] = Counter()
        ask, greet = node.overlay.ask, node.endpoint.discover

        def counted(contact: Contact, method: str, *arguments: object, **how: Any) -> Any:
            asked[contact.node_id] += method == "ping"
            return ask(contact, method, *arguments, **how)

        def greeted(address: Address, *arguments: Any) -> Any:
            asked[next(c.node_id for c in node.overlay.contacts() if c.address == address)] += 1
            return greet(address, *arguments)

        self.patch(node.overlay, "ask", counted)
        self.patch(node.endpoint, "discover", greeted)
        return asked

    def far(self, node: EntangledNode) -> Contact:
        """Return a contact of the node that is not one of its neighbours."""
        near = node.overlay.find_neighbours()
        return next(c for c in reversed(node.overlay.contacts()) if c not in near)

    def found(self, fleet: EntangledTeam, node: EntangledNode, target: bytes) -> list[Contact]:
        """Return the contacts that a node finds closest to an id."""
        return self.done(fleet, node.find_node(target), 2.0)

    def test_a_lookup_finds_who_let_go_of_the_session(self) -> None:
        """Lookups over slow paths find the closest nodes, even if nodes closed sessions that their peers still use."""
        fleet = self.large(weather=LinkConditions(0.08))
        node, target = fleet.nodes[0], self.far(fleet.nodes[0]).node_id
        others = [other.contact for other in fleet.nodes[1:]]
        self.assertEqual(self.found(fleet, node, target), select_closest(others, target, K))
        self.patch(node.endpoint, "forget_silent", lambda seconds: None)  # disables the periodic cleanup by this node
        fleet.run(SESSION_S)
        for other in fleet.nodes[1:]:
            other.endpoint.forget_silent(SESSION_S)
        self.assertEqual(self.found(fleet, node, target), select_closest(others, target, K))

    def far_from(self, fleet: EntangledTeam, key: bytes) -> tuple[EntangledNode, EntangledNode]:
        """Return the node farthest from a key, and the contact that this node queries first.

        The k nodes closest to the key are removed from the contacts of the farthest node.
        """
        order = select_closest([node.contact for node in fleet.nodes], key, len(fleet.nodes))
        reader, first = (fleet.nodes[contact.address.port - 7000] for contact in (order[-1], order[K]))
        for contact in order[:K]:
            reader.overlay.table.remove(contact)
            reader.overlay.members.remove(contact.node_id)
        self.assertEqual(reader.overlay.find_nearest(key)[0], first.contact)
        return reader, first

    def test_a_fast_read_goes_past_who_wrote(self) -> None:
        """A fast read of a key with many writers returns all their records.

        The read does not end at the first queried node, which stores only one old record.
        """
        fleet = self.large()
        key = hash_key("all write here")
        for node in fleet.nodes:
            self.done(fleet, node.put(key, "x", b"here", "leased", lease=30.0))
        reader, first = self.far_from(fleet, key)
        own = Record(key, "x", first.identity.public, 1, "leased", 30.0, b"here").sign(first.identity)
        first.replica.store_locally(own)  # stored when the node was one of the closest
        self.assertEqual(len(self.done(fleet, reader.get(key, "fast"))), len(fleet.nodes))

    def test_a_fast_read_takes_what_is_left(self) -> None:
        """A fast read returns a record that only one node outside the k closest nodes still stores."""
        fleet = self.large()
        key = hash_key("left behind")
        reader, first = self.far_from(fleet, key)
        record = Record(key, "x", first.identity.public, 1, "team", 60.0, b"old").sign(first.identity)
        first.replica.store_locally(record)
        self.assertEqual(self.done(fleet, reader.get(key, "fast")), [record])

    def test_many_lookups_that_meet_the_same_strangers(self) -> None:
        """Concurrent lookups share one handshake per node, and each finds exactly the closest nodes."""
        fleet = self.large()
        node, dice = fleet.nodes[0], random.Random(4)
        others = [other.contact for other in fleet.nodes[1:]]
        for other in others[::3]:  # a request can wait for one such round trip, but not for two
            fleet.switchboard.set_conditions(node.contact.address, other.address, LinkConditions(0.13))
        for each in fleet.nodes:
            each.endpoint.forget_silent(0.0)
        targets = [dice.randbytes(ID_BYTES) for _ in range(12)]
        looked = [Deferred.fromCoroutine(node.overlay.lookup(target)) for target in targets]
        fleet.run(5.0)
        for target, one in zip(targets, looked, strict=True):
            self.assertEqual(self.successResultOf(one), select_closest(others, target, K))

    def test_neighbours_are_asked_often_and_others_rarely(self) -> None:
        """Neighbours are pinged at least about every twelve seconds, other contacts rarely."""
        fleet = self.large()
        node = fleet.nodes[0]
        near = {contact.node_id for contact in node.overlay.find_neighbours()}
        asked = self.pings(node)
        fleet.run(INITIAL_SILENCE_S / 2)
        self.assertGreater(sum(asked[node_id] for node_id in near), K)
        self.assertEqual(sum(asked.values()), sum(asked[node_id] for node_id in near))
        silent = max(node.overlay.silence(contact) for contact in node.overlay.find_neighbours())
        self.assertLess(silent, NEIGHBOUR_SILENCE_S + 1.5)
        asked.clear()
        fleet.run(5 * INITIAL_SILENCE_S)
        far = [contact.node_id for contact in node.overlay.contacts() if contact.node_id not in near]
        self.assertTrue(far and all(asked[node_id] <= 5 for node_id in far), asked)
        self.assertGreater(sum(asked[node_id] for node_id in far), 0)
        self.assertFalse(any(each.overlay.is_complete for each in fleet.nodes))  # no node knows all nodes
        routed = self.far(node)
        node._membership.prober.needs_keep_alive = lambda contact: contact == routed
        asked.clear()
        fleet.run(INITIAL_SILENCE_S)
        self.assertGreater(asked[routed.node_id], 1)  # a path through a NAT stays open only while it is used

    def test_the_dead_cost_no_handshakes(self) -> None:
        """A far contact that failed is removed after one unanswered request, without a handshake."""
        fleet = self.large()
        node = fleet.nodes[0]
        far = self.far(node)
        next(other for other in fleet.nodes if other.contact == far).stop_silently()
        knocked: list[Address] = []
        send = SwitchboardNetwork.send

        def sent(network: SwitchboardNetwork, datagram: bytes, to: Address) -> None:
            knocked.extend([to] if datagram[0] == INIT and network.address == node.contact.address else [])
            send(network, datagram, to)

        self.patch(SwitchboardNetwork, "send", sent)
        fleet.run(4 * INITIAL_SILENCE_S)
        self.assertNotIn(far.node_id, [contact.node_id for contact in node.overlay.contacts()])
        self.assertNotIn(far.address, knocked)

    def test_one_without_a_radio_keeps_its_contacts(self) -> None:
        """A node that hears no other node keeps its contacts, because it considers itself disconnected."""
        fleet = self.large()
        before = len(fleet.nodes[5].overlay.contacts())
        fleet.nodes[5]._membership.prober.interval.silence_s = 1.0
        fleet.switchboard.partition([fleet.address(5)])
        fleet.run(6.0)
        self.assertGreater(len(fleet.nodes[5].overlay.contacts()), before - K)
        fleet.switchboard.heal()
        fleet.run(20.0)
        target = fleet.nodes[7].identity.node_id
        others = [other.contact for other in fleet.nodes if other is not fleet.nodes[5]]
        self.assertEqual(self.found(fleet, fleet.nodes[5], target), select_closest(others, target, K))

    def test_silent_sessions_are_let_go_and_come_back(self) -> None:
        """A session without traffic for a long time is closed; the next request opens a new session and is answered."""
        fleet = self.large()
        node = fleet.nodes[0]
        fleet.run(INITIAL_SILENCE_S)
        far = self.far(node)
        node._membership.prober.interval.silence_s = 10 * SESSION_S
        other = next(other for other in fleet.nodes if other.contact == far)
        other._membership.prober.interval.silence_s = 10 * SESSION_S
        fleet.run(SESSION_S + 60.0)
        self.assertFalse(node.endpoint.has_session(far))
        self.assertIn(far, node.overlay.contacts())
        self.assertTrue(node.endpoint.has_session(node.overlay.find_neighbours()[0]))
        self.done(fleet, node.call(far, "ping", b"", changes=True), 1.0)
        self.assertTrue(node.endpoint.has_session(far))

    def test_a_stranger_without_a_place_is_let_be(self) -> None:
        """A node does not ping an unknown node that cannot enter the routing table."""
        fleet = self.large()
        node = fleet.nodes[0]
        asked = self.pings(node)
        stranger = Contact(bytes([9]) * 32, Address("10.0.0.9", 9))
        self.patch(node.overlay.table, "has_room", lambda node_id: False)
        node.overlay.process_message(stranger)
        self.assertNotIn(stranger.node_id, asked)
        self.patch(node.overlay.table, "has_room", lambda node_id: True)
        node.overlay.process_message(stranger)
        self.assertIn(stranger.node_id, asked)

    def test_a_newcomer_says_what_it_was_told(self) -> None:
        """A node tells a new node for how many more seconds the network counts as large.

        The new node applies this answer immediately.
        """
        fleet = self.large()
        node = fleet.nodes[3]
        answer = node._membership._answer_members
        self.assertIsNone(answer(fleet.nodes[0].contact, b""))
        self.patch(overlay, "MAX_MEMBERS", 100)
        node._membership._large_until = fleet.clock.seconds() + 7.5
        self.assertEqual(answer(fleet.nodes[0].contact, b""), 7)

        newcomer = fleet.make_node(30)
        fleet.nodes.append(newcomer)
        fleet.start_node(newcomer, [fleet.address(2)])
        fleet.run(0.01)
        self.assertEqual((newcomer.overlay.is_large, newcomer.overlay.has_found_neighbours), (True, False))

    def test_who_failed_a_lookup_is_asked_at_once(self) -> None:
        """A far contact that failed in a lookup is excluded, and is included again as soon as it replies."""
        fleet = self.large()
        node = fleet.nodes[0]
        far = self.far(node)
        for bucket in node.overlay.table._buckets:
            bucket.replacements.clear()  # otherwise a waiting contact would replace the failed contact
        node.overlay.record_miss(far)
        self.assertNotIn(far, node.overlay.table.closest(far.node_id))
        fleet.run(3.0)
        self.assertFalse(node.overlay.is_suspect(far))
        self.assertIn(far, node.overlay.table.closest(far.node_id))

    def test_strangers_are_given_the_time_that_others_take(self) -> None:
        """In a slow network a request to an unknown node is not retransmitted before the usual round-trip time."""
        fleet = self.large()
        node, stranger = fleet.nodes[0], Contact(fleet.identity(99).public, Address("10.0.0.9", 9))
        for _ in range(9):
            node.endpoint.peers.overall_round_trip.add_sample(0.3)
        self.assertGreaterEqual(node.endpoint.peers.get_or_create(stranger).round_trip.timeout, 0.3)
        self.assertGreaterEqual(node.overlay.hedge_delay(), MAX_HEDGE_S)
        self.assertGreater(node.overlay.lookup_timeout or 0.0, 0.6)
        node.overlay.leave_large_mode()
        other = Contact(fleet.identity(98).public, Address("10.0.0.9", 8))
        self.assertEqual(node.endpoint.peers.get_or_create(other).round_trip.timeout, INITIAL_TIMEOUT_S)
        self.assertIsNone(node.overlay.lookup_timeout)

    def test_a_network_that_shrank_is_known_whole_again(self) -> None:
        """Two minutes after the network shrank below the limit, each node starts to learn all members."""
        fleet = self.large(16)
        for place in range(8, 16):
            fleet.nodes[place].stop()
        fleet.run(2 * LARGE_REPORT_S)
        self.assertFalse(any(node.overlay.is_complete for node in fleet.nodes[:8]))
        fleet.run(2 * LARGE_REPORT_S)
        self.assertTrue(all(node.overlay.is_complete for node in fleet.nodes[:8]))
        self.assertEqual({len(node.overlay.members) for node in fleet.nodes[:8]}, {7})

    def test_values_are_kept(self) -> None:
        """After a quarter of the nodes failed, a record is still readable, and is stored by the closest nodes left."""
        fleet = self.large()
        key = fleet.nodes[2].identity.node_id
        self.assertGreaterEqual(self.done(fleet, fleet.nodes[1].put(key, "a", b"1"), 2.0), 5)
        for place in (4, 8, 12, 16, 20, 23):
            fleet.nodes[place].stop_silently()
        fleet.run(60.0)
        [record] = self.done(fleet, fleet.nodes[6].get(key), 3.0)
        self.assertEqual(record.value, b"1")
        live = [n for n in fleet.nodes if n._running]
        holders = select_closest([node.contact for node in live], key, K)
        held = sum(bool(n.store.get(key)) for n in live if n.contact in holders)
        self.assertGreaterEqual(held, K - 1)
        self.assertIsInstance(fleet.nodes[6].find_node(key), Deferred)


class ProbeIntervalTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.pace = ProbeInterval()

    def test_within_bounds(self) -> None:
        """Without failures the ping interval increases to its maximum.

        With only failures it decreases to its minimum.
        """
        self.assertEqual(self.pace.silence_s, INITIAL_SILENCE_S)
        for _ in range(100):
            self.pace.record_answer()
        self.assertEqual(self.pace.silence_s, MAX_SILENCE_S)
        for _ in range(100):
            self.pace.record_loss()
        self.assertEqual(self.pace.silence_s, MIN_SILENCE_S)

    def test_it_follows_what_is_seen(self) -> None:
        """For usual session lengths the ping interval adapts until about one in twenty pinged contacts has failed."""
        dice = random.Random(1)
        for stay in (600.0, 1500.0, 4000.0):
            gone = asked = 0
            for _ in range(20_000):
                if dice.random() < 1 - 2.718 ** (-self.pace.silence_s / stay):
                    self.pace.record_loss()
                    gone += 1
                else:
                    self.pace.record_answer()
                asked += 1
            self.assertApproximates(gone / asked, TARGET_FAILURES, 0.02)
