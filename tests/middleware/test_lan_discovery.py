"""Tests of discovery on a simulated LAN."""

from __future__ import annotations

import random

from middleware.entangled.kademlia.lan_discovery import LISTEN_S, TARGET_REPLIES
from middleware.entangled.network.multicast import SimulatedLan, SimulatedMulticast
from middleware.entangled.network.network import Address
from middleware.entangled.node import EntangledNode
from middleware.entangled.wire.discovery import DISCOVERY, DISCOVERY_REPLY
from middleware.entangled.wire.probe import PROBE
from middleware.entangled.wire.session import INIT
from tests.fleet import TEAM_KEY, EntangledTeam, FleetCase


class Lan(EntangledTeam):
    """Nodes without known addresses on one LAN segment."""

    def __init__(self) -> None:
        super().__init__(0)
        self.segment = SimulatedLan(self.switchboard)
        self.groups: list[SimulatedMulticast] = []

    def on(
        self, place: int, *known: Address, segment: SimulatedLan | None = None, team: bytes = TEAM_KEY
    ) -> EntangledNode:
        """Create and start the node with this number on ``segment``."""
        group = (segment or self.segment).join()
        network = self.switchboard.make_network(*self.address(place))
        identity, store, rng = self.identity(place), self.store(place), self.make_life_rng(place)
        node = EntangledNode(identity, team, network, store, self.clock, rng, lan=group)
        self.groups.append(group)
        self.nodes.append(node)
        self.start_node(node, list(known))
        return node

    def traffic(self) -> dict[str, int]:
        """Return the counters, each summed over all nodes."""
        counted = [node.discovery.counters for node in self.nodes if node.discovery is not None]
        return {name: sum(each[name] for each in counted) for name in ("calls", "answered", "left", "greeted")}


class DiscoveryTests(FleetCase):
    """Tests of ``LanDiscovery``."""

    def lan(self) -> Lan:
        """Return a LAN that is stopped after the test."""
        lan = Lan()
        self.worlds.append(lan)
        return lan

    def test_two_find_each_other(self) -> None:
        """Two nodes without known nodes join within 0.5 s.

        If a node later loses all its peers, it soon searches for others.
        """
        lan = self.lan()
        a, b = lan.on(0), lan.on(1)
        lan.run(0.5)
        self.assertEqual(a.overlay.contacts(), [b.contact])
        self.assertEqual(b.overlay.contacts(), [a.contact])
        b.stop_silently()
        lan.run(30.0)
        c = lan.on(2)
        lan.run(1.0)
        self.assertIn(c.contact, a.overlay.contacts())

    def test_newcomer_is_not_whole_before_it_met_all(self) -> None:
        """If a node joins through the LAN, its member table is complete only after contact with all members."""
        lan = self.lan()
        for place in range(6):
            lan.on(place)
            lan.run(1.0)
        newcomer = lan.on(6)
        while not newcomer.overlay.contacts():
            lan.run(0.001)
        self.assertFalse(newcomer.overlay.has_all_members)
        while not newcomer.overlay.has_all_members:
            lan.run(0.001)
        self.assertEqual(len(newcomer.overlay.contacts()), 6)

    def test_first_of_a_network_waits_a_moment(self) -> None:
        """A node that gets no reply starts a team as its first node after ``LISTEN_S`` seconds, but not earlier."""
        lan = self.lan()
        lan.nodes.append(node := lan.make_node(0))
        node.stop()
        alone = lan.on(1)
        joined = alone.join([])
        lan.run(LISTEN_S - 0.05)
        self.assertFalse(joined.called)
        self.done(lan, joined, 0.1)
        self.assertTrue(alone.overlay.has_all_members)

    def test_storm_of_a_hundred_stays_small(self) -> None:
        """A hundred nodes that start at the same time form one network; each query gets few replies."""
        lan = self.lan()
        for place in range(100):
            lan.on(place)
        lan.run(20.0)
        self.assertGreaterEqual(min(len(node.overlay.contacts()) for node in lan.nodes), 8)
        self.assertEqual({(node.overlay.has_all_members, node.overlay.is_large) for node in lan.nodes}, {(False, True)})
        last, first = lan.nodes[-1], lan.nodes[0]
        self.assertEqual(self.done(lan, last.find_node(first.identity.node_id))[0], first.contact)
        traffic = lan.traffic()
        self.assertLess(traffic["calls"], 120)
        self.assertLess(traffic["answered"], 2 * TARGET_REPLIES * traffic["calls"])
        self.assertLess(traffic["greeted"], 350)

    def test_team_in_company_is_quiet(self) -> None:
        """Ten connected nodes together send about two discovery queries per minute."""
        lan = self.lan()
        for place in range(10):
            lan.on(place)
        lan.run(30.0)
        before = lan.traffic()["calls"]
        lan.run(600.0)
        self.assertLess(lan.traffic()["calls"] - before, 30)

    def test_two_halves_become_one(self) -> None:
        """Two separate networks of one team merge soon after their LANs are connected."""
        lan = self.lan()
        other = SimulatedLan(lan.switchboard)
        for place in range(3):
            lan.on(place)
            lan.on(place + 3, segment=other)
        lan.run(5.0)
        self.assertEqual({len(node.overlay.contacts()) for node in lan.nodes}, {2})
        lan.segment.groups += other.groups
        other.groups = lan.segment.groups
        lan.run(150.0)
        self.assertEqual({len(node.overlay.contacts()) for node in lan.nodes}, {5})

    def test_new_interface_is_called_at_once(self) -> None:
        """A node that is connected to a different LAN sends a discovery query there immediately."""
        lan = self.lan()
        lan.segment.is_blocked = True
        a, b = lan.on(0), lan.on(1)
        lan.run(60.0)
        self.assertEqual(a.overlay.contacts(), [])
        lan.segment.is_blocked = False
        lan.groups[0].on_moved()
        lan.run(0.3)
        self.assertEqual(a.overlay.contacts(), [b.contact])

    def test_strangers_change_nothing(self) -> None:
        """Other teams are ignored, a replayed query gets one reply, and forged replies cause few handshakes."""
        lan = self.lan()
        a, b = lan.on(0), lan.on(1, team=b"o" * 32)
        lan.run(5.0)
        assert a.discovery is not None
        self.assertEqual([*a.overlay.contacts(), *b.overlay.contacts()], [])
        self.assertGreater(a.discovery.counters["foreign"], 0)
        self.assertEqual(a.discovery.counters["answered"], 0)
        call, noise = a.endpoint.discoverer.make_multicast(), random.Random(5)
        thief = lan.segment.join()
        got: list[bytes] = []
        thief.listen(lambda datagram, source: got.append(datagram), lambda: None)
        for _ in range(50):
            thief.send(call)
            lan.run(0.2)
        self.assertEqual(len([datagram for datagram in got if datagram[0] == DISCOVERY_REPLY]), 1)
        a.discovery.counters.clear()
        for kind in (0, INIT, DISCOVERY, DISCOVERY_REPLY, PROBE):
            for size in (0, 1, 88, 89, 400):
                thief.send((bytes([kind]) + noise.randbytes(size))[:size])
        lan.run(5.0)
        thief.close()
        self.assertEqual(a.overlay.contacts(), [])
        self.assertLessEqual(a.discovery.counters["greeted"], 2)

    def test_known_node_that_is_gone_is_no_bar(self) -> None:
        """If the configured known node has failed, a node joins through another node on the LAN."""
        lan = self.lan()
        first = lan.on(0)
        lan.run(1.0)
        node = lan.on(1, Address("10.0.0.99", 7000))
        lan.run(2.0)
        self.assertEqual(node.overlay.contacts(), [first.contact])
