"""Tests of networks that are too large for a roster, with a limit of twelve members."""

from __future__ import annotations

import random
from collections import Counter
from typing import Any

from twisted.internet.defer import Deferred
from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.contact import Contact
from middleware.entangled.identity import ID_BYTES
from middleware.entangled.kademlia import membership, overlay, roster
from middleware.entangled.kademlia.distance import closest
from middleware.entangled.kademlia.membership import LARGE_FOR
from middleware.entangled.kademlia.overlay import MOST_HEDGE, K
from middleware.entangled.kademlia.sounding import FIRST, GONE, LEAST, MOST, NEAR_SILENCE, SESSION_S, Pace
from middleware.entangled.network.network import Address
from middleware.entangled.network.switchboard import CALM, SwitchboardNetwork, Weather
from middleware.entangled.node import EntangledNode
from middleware.entangled.record import Record, hashed_key
from middleware.entangled.wire.congestion import FIRST_GUESS
from middleware.entangled.wire.session import INIT
from tests.fleet import Fleet, FleetCase

MANY = 12


class LargeTests(FleetCase):
    def setUp(self) -> None:
        super().setUp()
        for module in (membership, overlay, roster):
            self.patch(module, "MAX_MEMBERS", MANY)

    def large(self, n: int = 24, weather: Weather = CALM) -> Fleet:
        fleet = self.fleet(n, seed=3, weather=weather)
        fleet.run(20.0)
        self.assertTrue(all(node.overlay.is_large for node in fleet.nodes))
        return fleet

    def pings(self, node: EntangledNode) -> Counter[bytes]:
        """Return a counter of the later pings of a node by target."""
        asked: Counter[bytes] = Counter()
        ask, greet = node.overlay.ask, node.endpoint.greet

        def counted(contact: Contact, method: str, *arguments: object, **how: Any) -> Any:
            asked[contact.node_id] += method == "ping"
            return ask(contact, method, *arguments, **how)

        def greeted(address: Address, *arguments: Any) -> Any:
            asked[next(c.node_id for c in node.overlay.contacts() if c.address == address)] += 1
            return greet(address, *arguments)

        self.patch(node.overlay, "ask", counted)
        self.patch(node.endpoint, "greet", greeted)
        return asked

    def far(self, node: EntangledNode) -> Contact:
        """Return a contact of the node that is not one of its neighbours."""
        near = node.overlay.neighbours()
        return next(c for c in reversed(node.overlay.contacts()) if c not in near)

    def found(self, fleet: Fleet, node: EntangledNode, target: bytes) -> list[Contact]:
        """Return the contacts that a node finds closest to an id."""
        return self.done(fleet, node.find_node(target), 2.0)

    def test_a_lookup_finds_who_let_go_of_the_session(self) -> None:
        """Lookups over slow paths are exact, also if some nodes have closed sessions that their peers still have."""
        fleet = self.large(weather=Weather(0.08))
        node, target = fleet.nodes[0], self.far(fleet.nodes[0]).node_id
        others = [other.contact for other in fleet.nodes[1:]]
        self.assertEqual(self.found(fleet, node, target), closest(others, target, K))
        self.patch(node.endpoint, "let_go", lambda seconds: None)  # prevents the periodic cleanup by this node
        fleet.run(SESSION_S)
        for other in fleet.nodes[1:]:
            other.endpoint.let_go(SESSION_S)
        self.assertEqual(self.found(fleet, node, target), closest(others, target, K))

    def far_from(self, fleet: Fleet, key: bytes) -> tuple[EntangledNode, EntangledNode]:
        """Return the node farthest from a key, with no holder as a contact, and the contact that it queries first."""
        order = closest([node.contact for node in fleet.nodes], key, len(fleet.nodes))
        reader, first = (fleet.nodes[contact.address.port - 7000] for contact in (order[-1], order[K]))
        for contact in order[:K]:
            reader.overlay.table.remove(contact)
            reader.overlay.roster.left(contact.node_id)
        self.assertEqual(reader.overlay.nearest(key)[0], first.contact)
        return reader, first

    def test_a_fast_read_goes_past_who_wrote(self) -> None:
        """A fast read of a key with many writers is complete although the first queried node has one old record."""
        fleet = self.large()
        key = hashed_key("all write here")
        for node in fleet.nodes:
            self.done(fleet, node.put(key, "x", b"here", "leased", lease=30.0))
        reader, first = self.far_from(fleet, key)
        own = Record(key, "x", first.identity.public, 1, "leased", 30.0, b"here").signed(first.identity)
        first.replica.keep(own)  # from a time when the node was one of the closest
        self.assertEqual(len(self.done(fleet, reader.get(key, "fast"))), len(fleet.nodes))

    def test_a_fast_read_takes_what_is_left(self) -> None:
        """A fast read returns a record that only a node outside the k closest still has."""
        fleet = self.large()
        key = hashed_key("left behind")
        reader, first = self.far_from(fleet, key)
        record = Record(key, "x", first.identity.public, 1, "team", 60.0, b"old").signed(first.identity)
        first.replica.keep(record)
        self.assertEqual(self.done(fleet, reader.get(key, "fast")), [record])

    def test_many_lookups_that_meet_the_same_strangers(self) -> None:
        """Concurrent lookups that share one handshake per node are exact."""
        fleet = self.large()
        node, dice = fleet.nodes[0], random.Random(4)
        others = [other.contact for other in fleet.nodes[1:]]
        for other in others[::3]:  # a request has time for one such round trip, not for two
            fleet.board.set_weather(node.contact.address, other.address, Weather(0.13))
        for each in fleet.nodes:
            each.endpoint.let_go(0.0)
        targets = [dice.randbytes(ID_BYTES) for _ in range(12)]
        looked = [Deferred.fromCoroutine(node.overlay.lookup(target)) for target in targets]
        fleet.run(5.0)
        for target, one in zip(targets, looked, strict=True):
            self.assertEqual(self.successResultOf(one), closest(others, target, K))

    def test_neighbours_are_asked_often_and_others_rarely(self) -> None:
        """Neighbours are pinged at least about every twelve seconds, other contacts rarely."""
        fleet = self.large()
        node = fleet.nodes[0]
        near = {contact.node_id for contact in node.overlay.neighbours()}
        asked = self.pings(node)
        fleet.run(FIRST / 2)
        self.assertGreater(sum(asked[node_id] for node_id in near), K)
        self.assertEqual(sum(asked.values()), sum(asked[node_id] for node_id in near))
        silent = max(node.overlay.silence(contact) for contact in node.overlay.neighbours())
        self.assertLess(silent, NEAR_SILENCE + 1.5)
        asked.clear()
        fleet.run(5 * FIRST)
        far = [contact.node_id for contact in node.overlay.contacts() if contact.node_id not in near]
        self.assertTrue(far and all(asked[node_id] <= 5 for node_id in far), asked)
        self.assertGreater(sum(asked[node_id] for node_id in far), 0)
        self.assertFalse(any(each.overlay.is_complete for each in fleet.nodes))  # the contacts are not the team
        routed = self.far(node)
        node._membership.sounding.needs_use = lambda contact: contact == routed
        asked.clear()
        fleet.run(FIRST)
        self.assertGreater(asked[routed.node_id], 1)  # a path through a NAT stays open only while it is used

    def test_the_dead_cost_no_handshakes(self) -> None:
        """A failed far contact is removed after one request, without a handshake."""
        fleet = self.large()
        node = fleet.nodes[0]
        far = self.far(node)
        next(other for other in fleet.nodes if other.contact == far).vanish()
        knocked: list[Address] = []
        send = SwitchboardNetwork.send

        def sent(network: SwitchboardNetwork, datagram: bytes, to: Address) -> None:
            knocked.extend([to] if datagram[0] == INIT and network.address == node.contact.address else [])
            send(network, datagram, to)

        self.patch(SwitchboardNetwork, "send", sent)
        fleet.run(4 * FIRST)
        self.assertNotIn(far.node_id, [contact.node_id for contact in node.overlay.contacts()])
        self.assertNotIn(far.address, knocked)

    def test_one_without_a_radio_keeps_its_contacts(self) -> None:
        """A node that hears no other node keeps its contacts, because it counts as disconnected."""
        fleet = self.large()
        before = len(fleet.nodes[5].overlay.contacts())
        fleet.nodes[5]._membership.sounding.pace.wait = 1.0
        fleet.board.partition([fleet.address(5)])
        fleet.run(6.0)
        self.assertGreater(len(fleet.nodes[5].overlay.contacts()), before - K)
        fleet.board.heal()
        fleet.run(20.0)
        target = fleet.nodes[7].identity.node_id
        others = [other.contact for other in fleet.nodes if other is not fleet.nodes[5]]
        self.assertEqual(self.found(fleet, fleet.nodes[5], target), closest(others, target, K))

    def test_silent_sessions_are_let_go_and_come_back(self) -> None:
        """A session without traffic for a long time is closed; the next request opens a new one and is answered."""
        fleet = self.large()
        node = fleet.nodes[0]
        fleet.run(FIRST)
        far = self.far(node)
        node._membership.sounding.pace.wait = 10 * SESSION_S
        other = next(other for other in fleet.nodes if other.contact == far)
        other._membership.sounding.pace.wait = 10 * SESSION_S
        fleet.run(SESSION_S + 60.0)
        self.assertFalse(node.endpoint.is_met(far))
        self.assertIn(far, node.overlay.contacts())
        self.assertTrue(node.endpoint.is_met(node.overlay.neighbours()[0]))
        self.done(fleet, node.call(far, "ping", b"", changes=True), 1.0)
        self.assertTrue(node.endpoint.is_met(far))

    def test_a_stranger_without_a_place_is_let_be(self) -> None:
        """A node does not ping a stranger that would find no place in the routing table."""
        fleet = self.large()
        node = fleet.nodes[0]
        asked = self.pings(node)
        stranger = Contact(bytes([9]) * 32, Address("10.0.0.9", 9))
        self.patch(node.overlay.table, "has_place", lambda node_id: False)
        node.overlay.heard(stranger)
        self.assertNotIn(stranger.node_id, asked)
        self.patch(node.overlay.table, "has_place", lambda node_id: True)
        node.overlay.heard(stranger)
        self.assertIn(stranger.node_id, asked)

    def test_a_newcomer_says_what_it_was_told(self) -> None:
        """A node forwards the remaining time for which the network counts as large; a new node learns it at once."""
        fleet = self.large()
        node = fleet.nodes[3]
        answer = node._membership._answer_members
        self.assertIsNone(answer(fleet.nodes[0].contact, b""))
        self.patch(overlay, "MAX_MEMBERS", 100)
        node._membership._large_until = fleet.clock.seconds() + 7.5
        self.assertEqual(answer(fleet.nodes[0].contact, b""), 7)

        newcomer = fleet.made(30)
        fleet.nodes.append(newcomer)
        fleet.enter(newcomer, [fleet.address(2)])
        fleet.run(0.01)
        self.assertEqual((newcomer.overlay.is_large, newcomer.overlay.is_placed), (True, False))

    def test_who_failed_a_lookup_is_asked_at_once(self) -> None:
        """A far contact that failed in a lookup is excluded, and included again as soon as it answers."""
        fleet = self.large()
        node = fleet.nodes[0]
        far = self.far(node)
        for bucket in node.overlay.table._buckets:
            bucket.waiting.clear()  # otherwise a waiting contact would replace it
        node.overlay.missed(far)
        self.assertNotIn(far, node.overlay.table.closest(far.node_id))
        fleet.run(3.0)
        self.assertFalse(node.overlay.is_doubted(far))
        self.assertIn(far, node.overlay.table.closest(far.node_id))

    def test_strangers_are_given_the_time_that_others_take(self) -> None:
        """In a slow network a request to a stranger is not retransmitted before the usual round-trip time."""
        fleet = self.large()
        node, stranger = fleet.nodes[0], Contact(fleet.identity(99).public, Address("10.0.0.9", 9))
        for _ in range(9):
            node.endpoint.peers.usual.measured(0.3)
        self.assertGreaterEqual(node.endpoint.peers.peer(stranger).round_trip.wait, 0.3)
        self.assertGreaterEqual(node.overlay.hedge(), MOST_HEDGE)
        self.assertGreater(node.overlay.patience_of_lookups or 0.0, 0.6)
        node.overlay.shrank()
        other = Contact(fleet.identity(98).public, Address("10.0.0.9", 8))
        self.assertEqual(node.endpoint.peers.peer(other).round_trip.wait, FIRST_GUESS)
        self.assertIsNone(node.overlay.patience_of_lookups)

    def test_a_network_that_shrank_is_known_whole_again(self) -> None:
        """Two minutes after the network shrank below the limit, each node starts to learn all members."""
        fleet = self.large(16)
        for place in range(8, 16):
            fleet.nodes[place].stop()
        fleet.run(2 * LARGE_FOR)
        self.assertFalse(any(node.overlay.is_complete for node in fleet.nodes[:8]))
        fleet.run(2 * LARGE_FOR)
        self.assertTrue(all(node.overlay.is_complete for node in fleet.nodes[:8]))
        self.assertEqual({len(node.overlay.roster) for node in fleet.nodes[:8]}, {7})

    def test_values_are_kept(self) -> None:
        """After a quarter of the nodes failed, a stored record is readable and held by the new closest nodes."""
        fleet = self.large()
        key = fleet.nodes[2].identity.node_id
        self.assertGreaterEqual(self.done(fleet, fleet.nodes[1].put(key, "a", b"1"), 2.0), 5)
        for place in (4, 8, 12, 16, 20, 23):
            fleet.nodes[place].vanish()
        fleet.run(60.0)
        [record] = self.done(fleet, fleet.nodes[6].get(key), 3.0)
        self.assertEqual(record.value, b"1")
        live = [n for n in fleet.nodes if n._running]
        holders = closest([node.contact for node in live], key, K)
        held = sum(bool(n.store.get(key)) for n in live if n.contact in holders)
        self.assertGreaterEqual(held, K - 1)
        self.assertIsInstance(fleet.nodes[6].find_node(key), Deferred)


class PaceTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.pace = Pace()

    def test_within_bounds(self) -> None:
        """Without failures the ping interval grows up to its maximum, with only failures it falls to its minimum."""
        self.assertEqual(self.pace.wait, FIRST)
        for _ in range(100):
            self.pace.answered()
        self.assertEqual(self.pace.wait, MOST)
        for _ in range(100):
            self.pace.lost()
        self.assertEqual(self.pace.wait, LEAST)

    def test_it_follows_what_is_seen(self) -> None:
        """For usual session lengths the interval adapts until about one in twenty pinged contacts is gone."""
        dice = random.Random(1)
        for stay in (600.0, 1500.0, 4000.0):
            gone = asked = 0
            for _ in range(20_000):
                if dice.random() < 1 - 2.718 ** (-self.pace.wait / stay):
                    self.pace.lost()
                    gone += 1
                else:
                    self.pace.answered()
                asked += 1
            self.assertApproximates(gone / asked, GONE, 0.02)
