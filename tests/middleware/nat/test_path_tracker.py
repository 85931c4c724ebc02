"""Tests of the paths between two nodes behind simulated routers."""

from __future__ import annotations

import random
from typing import Any

from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.contact import Contact
from middleware.entangled.nat.path_kind import PeerPath, classify_path
from middleware.entangled.nat.path_tracker import EXTENSION_S, MAX_PORTS, UNUSED_PORT_S
from middleware.entangled.network.network import Address, relayed_address
from middleware.entangled.network.switchboard import LinkConditions
from middleware.entangled.node import EntangledNode
from middleware.entangled.wire.noise import TransportKeys
from middleware.entangled.wire.peer import Peer
from middleware.entangled.wire.session import Session
from tests.middleware.nat.sites import Sites, SitesCase

KINDS = ("none", "full", "addr", "port", "sym")
UNPUNCHABLE = {frozenset({"port", "sym"}), frozenset({"sym"})}


def paths(sites: Sites, one: str, other: str) -> tuple[str, float]:
    """Return the first path between nodes behind routers of these types, and after how long the path was found.

    The nodes join one after the other, and learn of each other from the member list of the public node.
    """
    a = sites.at("a", one)
    sites.run(2.0)
    b = sites.at("b", other)
    known, since = 0.0, sites.clock.seconds()
    while sites.clock.seconds() < since + 8.0:
        sites.run(0.01)
        to_b, to_a = a.endpoint.peers.get(b.identity.public), b.endpoint.peers.get(a.identity.public)
        if not known and (to_b or to_a):
            known = sites.clock.seconds()
        if to_b and to_a and to_b.session and to_a.session:
            return sites.way(a, b), sites.clock.seconds() - known
    return "none", float("inf")


class PathTests(SitesCase):
    """The path between each pair of router types."""

    def test_punchable_pairs_are_direct(self) -> None:
        """In 13 of the 15 pairs of router types hole punching succeeds within a second, and the path stays direct."""
        for one in KINDS:
            for other in KINDS:
                if frozenset({one, other}) not in UNPUNCHABLE:
                    path, seconds = paths(self.sites(), one, other)
                    self.assertEqual((one, other, path), (one, other, "direct"))
                    self.assertLess(seconds, 1.0, f"{one} and {other}")

    def test_other_pairs_are_carried(self) -> None:
        """If hole punching is impossible, the public node relays after at most 1.5 s."""
        for one, other in (("port", "sym"), ("sym", "port"), ("sym", "sym")):
            sites = self.sites()
            path, seconds = paths(sites, one, other)
            self.assertEqual((one, other, path), (one, other, "carried"))
            self.assertLess(seconds, 1.5, f"{one} and {other}")
            a, b = sites.nodes["a2"], sites.nodes["b2"]
            for requester, asked in ((a, b), (b, a)):
                self.assertEqual(sites.call(requester, sites.met_at(asked))[0], 7)


class LossyLinkTests(SitesCase):
    """Paths under loss and behind difficult routers."""

    def test_lossy_links(self) -> None:
        """At 30 % loss on both links at least 38 of 40 pairs connect within 5 s, by hole punching or a relay."""
        late = []
        pairs = [("port", "port"), ("full", "addr"), ("port", "sym"), ("none", "port")]
        for seed in range(10):
            for one, other in pairs:
                sites = self.sites(seed, LinkConditions(delay_s=0.015, loss=0.3))
                path, seconds = paths(sites, one, other)
                if seconds > 5.0:
                    late.append((seed, one, other, path, seconds))
        self.assertLessEqual(len(late), 2, late)

    def test_leaky_routers(self) -> None:
        """Nodes behind routers that block a port after an early datagram connect within 5 s from newly opened ports."""
        for one, other in (("leaky", "leaky"), ("leaky", "port"), ("port", "leaky")):
            for delay_s in (0.015, 0.25):
                sites = self.sites()
                sites.site("b", other)
                sites.switchboard.router_conditions[sites.routers["b"]] = LinkConditions(delay_s)
                _, seconds = paths(sites, one, other)
                self.assertLess(seconds, 5.0, f"{one} and {other}")
                sites.run(5.0)
                if delay_s < 0.1:
                    path = sites.way(sites.nodes["a2"], sites.nodes["b2"])
                    self.assertEqual((one, other, path), (one, other, "direct"))

    def test_late_words(self) -> None:
        """If one peer is notified half a second late, the pair is relayed at first, and later has a direct path."""
        for one, other in (("leaky", "port"), ("port", "leaky")):
            for late in "ab":
                sites = self.sites()
                sites.site("a", one)
                sites.site("b", other)
                host = sites.routers[late].host
                for port in range(6990, 7010):
                    sites.switchboard.set_conditions(
                        sites.public, Address(host, port), LinkConditions(delay_s=0.5), one_way=True
                    )
                ways_seen = set()
                paths(sites, one, other)
                sites.run(20.0)
                for _ in range(20):
                    sites.run(1.0)
                    ways_seen.add(sites.way(sites.nodes["a2"], sites.nodes["b2"]))
                self.assertEqual((one, other, late, ways_seen), (one, other, late, {"direct"}))

    def test_routers_within_a_private_net(self) -> None:
        """Hole punching also works if the public side of the routers is in a private network with the same prefix."""
        for one, other, path in (("port", "port", "direct"), ("sym", "full", "direct"), ("sym", "sym", "carried")):
            sites = self.sites(nets=("10.0.9", "10.0"))
            self.assertEqual((one, other, paths(sites, one, other)[0]), (one, other, path))

    def test_a_router_restarts(self) -> None:
        """If a router restarts with new ports, the node behind it is reachable within 5 s, even without traffic."""
        for one, other in (("port", "port"), ("full", "addr"), ("sym", "sym"), ("port", "none"), ("leaky", "port")):
            sites = self.sites()
            a = sites.at("a", one)
            sites.run(1.0)
            b = sites.at("b", other)
            sites.run(10.0)
            sites.routers["a"].rebind()
            self.assertLess(_reached_again(sites, a, b), 5.0, f"{one} and {other}")

    def test_mappings_are_held(self) -> None:
        """If routers keep a mapping for 15 s, two idle nodes keep their path open."""
        for one, other in (("port", "port"), ("sym", "sym")):
            sites = self.sites(lifetime=15.0)
            a, b = sites.at("a", one), sites.at("b", other)
            sites.run(60.0)
            to_b = a.overlay.members.get(b.identity.node_id)
            assert to_b is not None
            answer, seconds = sites.call(a, to_b)
            self.assertEqual(answer, 7)
            self.assertLess(seconds, 0.2)

    def test_everybody_hears_of_it(self) -> None:
        """In a large team all members also have the new address of an idle node after 5 s."""
        sites = self.sites()
        others = [sites.node(f"x{n}", Address(f"203.0.113.{150 + n}", 7000)) for n in range(32)]
        a = sites.at("a", "port")
        sites.run(21.0)
        sites.routers["a"].rebind()
        sites.run(5.0)
        seen = {peer.session.contact.address for other in others if (peer := _peer(other, a)) and peer.session}
        self.assertEqual(seen, {sites.met_at(a).address})
        self.assertNotEqual(seen, {Address(sites.routers["a"].host, 7000)})

    def test_fresh_ports_are_quiet(self) -> None:
        """If two nodes connected from newly opened ports, their session stays open.

        These ports do not count as new addresses.
        """
        sites = self.sites()
        paths(sites, "leaky", "leaky")
        a, b = sites.nodes["a2"], sites.nodes["b2"]
        sites.run(10.0)
        before = [peer and peer.session for peer in (_peer(a, b), _peer(b, a))]
        sites.run(30.0)
        self.assertEqual([peer and peer.session for peer in (_peer(a, b), _peer(b, a))], before)
        self.assertEqual((sites.way(a, b), sites.way(b, a)), ("direct", "direct"))
        peer = _peer(a, b)
        assert peer is not None and peer.session is not None
        at_b = peer.session.contact.address
        port = sites.networks["a2"].source_address(at_b).port
        self.assertIn(port, a.nat._additional_ports)
        a.nat.external.record(peer.session.contact, Address(sites.routers["a"].host, 3), is_change=True)
        self.assertEqual(len(a.endpoint.peers._handshakes), 0)
        a.nat._assign_port(peer, [at_b], 0)
        self.assertEqual(sites.networks["a2"].source_address(at_b).port, port)

    def test_direct_before_carried(self) -> None:
        """A relayed session does not replace a direct session that works, but replaces one that has failed."""
        sites = self.sites()
        a, b = sites.at("a", "none"), sites.at("b", "none")
        sites.run(3.0)
        a.call(b.contact, "echo", 1)
        sites.run(0.1)
        carried = Contact(b.identity.public, relayed_address(b.identity.node_id))
        for later, path in ((0.0, "direct"), (10.0, "carried")):
            if later:
                b.stop_silently()
                sites.run(later)
            keys = TransportKeys(bytes(32), bytes(32), bytes(32))
            session = Session(carried, 77 + int(later), 78, keys, sites.clock.seconds(), is_confirmed=True)
            a.endpoint.peers.add_session(session)
            self.assertEqual(sites.way(a, b), path)

    def test_another_address(self) -> None:
        """A node that moves to another network keeps its key and is reachable within 5 s."""
        sites = self.sites()
        a, b = sites.at("a", "port"), sites.at("b", "port")
        sites.run(5.0)
        sites.site("c", "port")
        sites.networks["a2"].router = sites.routers["c"]
        sites.switchboard._ports[sites.routers["c"], a.contact.address] = sites.networks["a2"]
        self.assertLess(_reached_again(sites, b, a), 5.0)
        self.assertEqual(sites.met_at(a).address.host, sites.routers["c"].host)


class RelayedTests(SitesCase):
    """Pairs of nodes with a relayed path."""

    def carried(self, sites: Sites) -> tuple[EntangledNode, EntangledNode]:
        """Return two nodes that have no direct path and have been relayed for some seconds."""
        a = sites.at("a", "sym")
        sites.run(1.0)
        b = sites.at("b", "sym")
        sites.run(4.0)
        self.assertEqual((sites.way(a, b), sites.way(b, a)), ("carried", "carried"))
        return a, b

    def test_direct_as_soon_as_it_can_be(self) -> None:
        """A relayed pair can exchange large messages, and gets a direct path when its routers permit this."""
        sites = self.sites()
        a, b = self.carried(sites)
        session = a.endpoint.peers.find_session(b.identity.public)
        assert session is not None
        large, got = random.Random(1).randbytes(20_000), list[Any]()
        a.call(session.contact, "echo", large).addBoth(got.append)
        sites.run(5.0)
        self.assertEqual(got, [large])
        for router in sites.routers.values():
            router.kind = "port"
        sites.run(70.0)
        self.assertEqual((sites.way(a, b), sites.way(b, a)), ("direct", "direct"))
        carried = sites.nodes["pub"].endpoint.counters["carried"]
        self.assertEqual(sites.call(a, sites.met_at(b))[0], 7)
        sites.run(10.0)
        self.assertEqual(sites.nodes["pub"].endpoint.counters["carried"], carried)

    def test_any_member_carries(self) -> None:
        """If the relay fails at any time, another member relays within 5 s."""
        for moment in range(8):
            sites = self.sites()
            sites.node("other", Address("203.0.113.200", 7000))
            a, b = self.carried(sites)
            to_b = a.overlay.members.get(b.identity.node_id)
            assert to_b is not None
            sites.run(moment / 4)
            sites.nodes["pub"].stop_silently()
            began = sites.clock.seconds()
            while sites.call(a, to_b)[0] != 7:
                self.assertLess(sites.clock.seconds() - began, 5.0)
            self.assertLess(sites.clock.seconds() - began, 5.0)

    def test_who_hears_of_it_reaches_it(self) -> None:
        """Other nodes reach a relayed peer directly if this is possible, otherwise through a relay."""
        sites = self.sites()
        _, b = self.carried(sites)
        for site, kind, path in (("c", "none", "direct"), ("d", "sym", "carried")):
            c = sites.at(site, kind)
            sites.run(2.5)
            self.assertEqual((kind, sites.way(c, b)), (kind, path))

    def test_who_named_it_is_asked(self) -> None:
        """If a node has only a relay address of a peer, it asks the announcing node for an introduction."""
        sites = self.sites()
        others = [sites.node(f"x{n}", Address(f"203.0.113.{150 + n}", 7000)) for n in range(16)]
        a = sites.at("a", "sym")
        sites.run(1.0)
        c = others[0]
        asked: list[bytes] = []
        for other in [sites.nodes["pub"], *others[1:]]:
            other.endpoint.expose("reach.introduce", _listening(other, asked), changes=True)
        b = sites.node("b", Address("203.0.113.220", 7000))
        sites.run(2.0)
        peers = c.endpoint.peers
        known = peers.get(b.identity.public)
        assert known is not None
        peers.evict(known)
        c.nat.selector.record_namer(Contact(b.identity.public, relayed_address(b.identity.node_id)), others[3].contact)
        asked.clear()
        answer, _ = sites.call(c, Contact(b.identity.public, relayed_address(b.identity.node_id)))
        self.assertEqual(answer, 7)
        self.assertIn(others[3].identity.node_id, asked[:3])
        self.assertEqual(sites.way(a, b), "direct")


def _peer(of: EntangledNode, other: EntangledNode) -> Peer | None:
    return of.endpoint.peers.get(other.identity.public)


def _listening(node: EntangledNode, asked: list[bytes]) -> Any:
    """Return a wrapper of the node's method that records its calls."""
    answer = node.nat.introducer.answer_introduce

    def introduce(peer: Contact, wanted: bytes, candidates: list[object], order: int) -> Any:
        asked.append(node.identity.node_id)
        return answer(peer, wanted, candidates, order)

    return introduce


def _reached_again(sites: Sites, asked: EntangledNode, requester: EntangledNode) -> float:
    """Return the seconds until a call from ``requester`` to the known address of ``asked`` is answered."""
    began = sites.clock.seconds()
    while sites.clock.seconds() < began + 20.0:
        contact = requester.overlay.members.get(asked.identity.node_id) or sites.met_at(asked)
        if sites.call(requester, contact)[0] == 7:
            return sites.clock.seconds() - began
        sites.run(0.2)
    return float("inf")


class AdditionalPortsTests(SitesCase):
    """Tests of ``AdditionalPorts`` on a node that does not need them."""

    def test_so_many_and_no_more(self) -> None:
        """At the limit a new port is opened only if the oldest port can be closed, which is after its hold time."""
        sites = self.sites()
        ports = sites.at("a", "none").nat._additional_ports
        opened = [ports.open() for _ in range(MAX_PORTS)]
        self.assertEqual((len(set(opened)), ports.open()), (MAX_PORTS, 0))
        sites.run(EXTENSION_S + 0.1)
        another = ports.open()
        self.assertNotEqual(another, 0)
        self.assertEqual(len(ports), MAX_PORTS)
        self.assertIn(another, ports)
        self.assertEqual([port in ports for port in opened], [False] + [True] * (MAX_PORTS - 1))

    def test_unused_ones_are_shut(self) -> None:
        """A newly opened port without a session is closed after ``UNUSED_PORT_S`` seconds."""
        sites = self.sites()
        reach = sites.at("a", "none").nat
        reach._open_port()
        sites.run(UNUSED_PORT_S - 1.0)
        self.assertEqual(len(reach._additional_ports), 1)
        sites.run(3.0)
        self.assertEqual(len(reach._additional_ports), 0)


OWN = Address("192.168.1.7", 8484)


class KindTests(SynchronousTestCase):
    """Tests of ``kind_of``."""

    def test_each_kind_of_address(self) -> None:
        """The address determines relayed, tunnelled and loopback paths.

        The path to a distant address that came from an introduction counts as hole punching.
        """
        kinds = {
            "carried": relayed_address(bytes(20)),
            "tunnel": Address("~wss-0123456789ab", 1),
            "machine": Address("127.0.0.1", 7000),
            "lan": Address("192.168.1.9", 8484),
            "direct": Address("203.0.113.9", 8484),
        }
        self.assertEqual([classify_path(address, OWN, False, False) for address in kinds.values()], list(kinds))
        self.assertEqual(classify_path(OWN, OWN, False, False), "machine")
        introduced = [classify_path(kinds[kind], OWN, False, True) for kind in ("lan", "direct")]
        self.assertEqual(introduced, ["lan", "punched"])


class PathKindTests(SitesCase):
    """Tests of ``PathTracker.find_path`` with simulated routers."""

    def passage(self, a: EntangledNode, b: EntangledNode) -> PeerPath:
        """Return the path from ``a`` to ``b``."""
        return a.nat.paths.find_path(b.contact)

    def test_kinds(self) -> None:
        """Nodes behind cone routers use hole punching, behind symmetric routers a relay, and at one site their LAN."""
        relay = self.sites().nodes["pub"].identity.node_id
        for one, other, site, kind in (
            ("port", "port", "b", "punched"),
            ("sym", "sym", "b", "carried"),
            ("sym", "sym", "a", "lan"),
        ):
            sites = self.sites()
            a = sites.at("a", one)
            sites.run(2.0)
            b = sites.at(site, other, 3)
            self.assertEqual(self.passage(a, b), PeerPath("none"))
            sites.run(6.0)
            for near, far in ((a, b), (b, a)):
                passage = self.passage(near, far)
                self.assertEqual((passage.kind, passage.by), (kind, relay if kind == "carried" else b""))
            self.assertEqual(self.passage(a, sites.nodes["pub"]).kind, "direct")

    def test_since(self) -> None:
        """The age of a path continues when a new session replaces the old session; a lost path is removed."""
        sites = self.sites()
        a, pub = sites.nodes["pub"], sites.at("b", "none")
        began = sites.clock.seconds()
        sites.run(60.0)
        since = self.passage(a, pub).since
        assert since is not None
        self.assertLess(abs(since - began), 1.0)
        a.endpoint.reopen(pub.contact)
        sites.run(10.0)
        self.assertEqual(self.passage(a, pub).since, since)
        pub.stop_silently()
        sites.run(60.0)
        self.assertNotIn(pub.identity.public, a.nat.paths._path_kinds)
