"""Tests of ``middleware.entangled.kademlia.alternate_path``: nodes with blocked UDP join through tunnels."""

from __future__ import annotations

import random

from twisted.internet.defer import Deferred
from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.contact import Contact, parse_contact
from middleware.entangled.identity import Identity
from middleware.entangled.network.combined_network import JointNetwork
from middleware.entangled.network.memory_streams import PipeNetwork
from middleware.entangled.network.network import Address, relayed_address
from middleware.entangled.network.tunnel import TunnelNetwork
from middleware.entangled.network.url import Url
from middleware.entangled.node import EntangledNode
from middleware.faults.network import FaultyNetwork
from tests.fleet import TEAM_KEY, Simulation

BOOTSTRAP = 0


class Site:
    """A node with its UDP network and its tunnel."""

    def __init__(self, world: TunnelWorld, place: int, urls: list[Url], is_served: bool = False) -> None:
        rng = world.make_life_rng(place)
        udp = world.switchboard.make_network(*world.address(place))
        self.udp = FaultyNetwork(udp, world.clock, random.Random(place))
        relay = world.pipes.make_transport(f"10.2.0.{place}", 443)
        self.tunnel = TunnelNetwork(relay, world.clock, rng, urls, is_served)
        network = JointNetwork(self.udp, self.tunnel)
        identity, store = world.identity(place), world.store(place)
        self.node = EntangledNode(identity, TEAM_KEY, network, store, world.clock, rng, 1.0)
        self.node.endpoint.expose("who", lambda peer: place)

    def block(self, is_blocked: bool = True) -> None:
        """Block all UDP, like a firewall."""
        self.udp.is_receive_blocked = self.udp.is_send_blocked = is_blocked


class TunnelWorld(Simulation):
    """A bootstrap node that accepts tunnels, and other nodes."""

    def __init__(self) -> None:
        super().__init__(1)
        self.pipes = PipeNetwork(self.clock, 0.025)
        self.sites: list[Site] = []

    def address(self, place: int) -> Address:
        """Return the address of a node; each node is in a separate network."""
        return Address(f"198.18.{place}.1", 7000)

    def url(self, place: int = BOOTSTRAP) -> Url:
        """Return the tunnel URL of a node."""
        return Url("wss", f"10.2.0.{place}", 443)

    def add(self, place: int, is_blocked: bool = False, is_served: bool = False) -> tuple[Site, Deferred[None]]:
        """Create a node that joins through the bootstrap node, by UDP or by tunnel."""
        site = Site(self, place, [] if is_served else [self.url()], is_served)
        site.block(is_blocked)
        known = [] if is_served else [self.address(BOOTSTRAP)]
        site.node.start()
        self.sites.append(site)
        return site, site.node.join(known)

    def stop(self) -> None:
        """Stop every node."""
        for site in self.sites:
            site.node.stop()


class AlternatePathsTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.world = TunnelWorld()
        self.addCleanup(self.end)
        self.bootstrap, _ = self.world.add(BOOTSTRAP, is_served=True)
        self.world.run(0.1)

    def end(self) -> None:
        """Stop all nodes and check that no timer is left."""
        self.world.stop()
        self.world.run(10.0)
        self.assertEqual(self.world.clock.getDelayedCalls(), [])

    def call(self, requester: Site, asked: Site) -> object:
        """Let ``requester`` call ``asked`` at an address that ``requester`` knows; return the answer."""
        (contact,) = (c for c in requester.node.overlay.contacts() if c.public == asked.node.identity.public)
        answer = requester.node.call(contact, "who")
        self.world.run(2.0)
        return self.successResultOf(answer)

    def test_enter_by_tunnel(self) -> None:
        """A node with blocked UDP joins within 2.5 s and exchanges large messages; other nodes open no tunnel."""
        _, joined = self.world.add(2)
        self.world.run(0.2)
        self.successResultOf(joined)
        self.world.run(120.0)
        self.assertEqual(self.world.pipes.dialled, [])
        site, joined = self.world.add(1, is_blocked=True)
        self.world.run(1.4)
        self.assertEqual(self.world.pipes.dialled, [])
        self.world.run(1.1)
        self.successResultOf(joined)
        self.assertEqual(self.call(site, self.bootstrap), BOOTSTRAP)
        self.assertEqual(self.call(self.bootstrap, site), 1)
        (contact,) = (c for c in self.bootstrap.node.overlay.contacts() if c.address.is_virtual)
        self.assertRegex(contact.address.host, "^~wss-")
        site.node.endpoint.expose("large", lambda peer: b"y" * 200_000)
        answer = self.bootstrap.node.call(contact, "large", timeout=20.0)
        self.world.run(20.0)
        self.assertEqual(self.successResultOf(answer), b"y" * 200_000)

    def test_others_are_told_no_tunnel(self) -> None:
        """A member that uses a tunnel is announced as relayed; a node uses no tunnel address that a peer sent."""
        other, _ = self.world.add(2)
        site, _ = self.world.add(1, is_blocked=True)
        self.world.run(4.0)
        asked = other.node.call(Contact(self.bootstrap.node.identity.public, self.world.address(0)), "members", b"")
        self.world.run(0.5)
        named = [parse_contact(fields) for fields in self.successResultOf(asked)]
        self.assertIn(Contact(site.node.identity.public, relayed_address(site.node.identity.node_id)), named)
        public = Identity(b"z" * 32).public
        for host in ("~wss-aabbccddeeff", "~" + "0" * 40, "~"):
            told = parse_contact([public, host, 443])
            assert told is not None
            self.assertEqual(told.address, relayed_address(told.node_id))
            self.assertEqual(Contact(public, Address(host, 1)).pack(), [public, *relayed_address(told.node_id)])

    def test_everybody_reaches_everybody(self) -> None:
        """Two members with blocked UDP and two without reach each other 4 s after the last of them started to join."""
        sites = [self.bootstrap]
        for place, is_blocked in ((1, True), (2, False), (3, True), (4, False)):
            sites.append(self.world.add(place, is_blocked)[0])
            self.world.run(4.0)
        for requester in sites:
            self.assertEqual(len(requester.node.overlay.contacts()), 4)
            for asked in sites:
                if asked is not requester:
                    self.assertEqual(self.call(requester, asked), self.sites_place(asked))

    def sites_place(self, site: Site) -> int:
        """Return the index of a site."""
        return [self.world.identity(place).public for place in range(5)].index(site.node.identity.public)

    def test_leave_the_tunnel(self) -> None:
        """When UDP works again, the session uses UDP within 16 s, and the tunnel is closed a minute later."""
        site, _ = self.world.add(1, is_blocked=True)
        self.world.run(10.0)
        site.block(False)
        self.world.run(16.0)
        (contact,) = site.node.overlay.contacts()
        self.assertEqual(contact.address, self.world.address(BOOTSTRAP))
        (contact,) = self.bootstrap.node.overlay.contacts()
        self.assertEqual(contact.address, self.world.address(1))
        self.assertEqual(self.call(site, self.bootstrap), BOOTSTRAP)
        self.world.run(65.0)
        self.assertEqual((site.tunnel.peers, self.bootstrap.tunnel.peers), ([], []))
        self.assertEqual(self.call(self.bootstrap, site), 1)

    def test_fall_back_when_contact_is_lost(self) -> None:
        """If UDP is blocked after a member joined, the member loses all contacts and then returns through a tunnel."""
        site, _ = self.world.add(1)
        self.world.run(5.0)
        site.block()
        self.world.run(15.0)
        self.assertEqual(len(site.tunnel.peers), 1)
        self.assertEqual(self.call(site, self.bootstrap), BOOTSTRAP)
        self.assertEqual(self.call(self.bootstrap, site), 1)

    def test_bootstrap_restarts(self) -> None:
        """A restarted bootstrap node does not wait for tunnelled members; they and new nodes join within 15 s."""
        site, _ = self.world.add(1, is_blocked=True)
        self.world.run(40.0)
        self.bootstrap.node.stop_silently()
        newcomer, waiting = self.world.add(2, is_blocked=True)
        self.world.run(20.0)
        self.assertNoResult(waiting)
        self.bootstrap, joined = self.world.add(BOOTSTRAP, is_served=True)
        self.world.run(0.5)
        self.successResultOf(joined)
        self.world.run(15.0)
        self.successResultOf(waiting)
        for each in (site, newcomer):
            self.assertEqual(self.call(each, self.bootstrap), BOOTSTRAP)

    def test_tunnel_alone(self) -> None:
        """A node that knows only a tunnel joins through it immediately, and never starts a separate team."""
        site = Site(self.world, 3, [self.world.url()])
        site.block()
        self.world.sites.append(site)
        site.node.start()
        joined = site.node.join([])
        self.world.run(0.6)
        self.successResultOf(joined)
        self.assertEqual(len(site.node.overlay.contacts()), 1)
