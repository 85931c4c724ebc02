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
from tests.middleware.nat.sites import Ground, GroundCase

KINDS = ("none", "full", "addr", "port", "sym")
UNPUNCHABLE = {frozenset({"port", "sym"}), frozenset({"sym"})}


def ways(ground: Ground, one: str, other: str) -> tuple[str, float]:
    """Return the first path between nodes behind routers of these types, and its delay after they met.

    The nodes join one after the other and learn of each other from the member list of the public node.
    """
    a = ground.at("a", one)
    ground.run(2.0)
    b = ground.at("b", other)
    known, since = 0.0, ground.clock.seconds()
    while ground.clock.seconds() < since + 8.0:
        ground.run(0.01)
        to_b, to_a = a.endpoint.peers.get(b.identity.public), b.endpoint.peers.get(a.identity.public)
        if not known and (to_b or to_a):
            known = ground.clock.seconds()
        if to_b and to_a and to_b.session and to_a.session:
            return ground.way(a, b), ground.clock.seconds() - known
    return "none", float("inf")


class WayTests(GroundCase):
    """The path between each pair of router types."""

    def test_punchable_pairs_are_direct(self) -> None:
        """13 of the 15 pairs of router types are punched within a second and use direct paths from then on."""
        for one in KINDS:
            for other in KINDS:
                if frozenset({one, other}) not in UNPUNCHABLE:
                    way, seconds = ways(self.ground(), one, other)
                    self.assertEqual((one, other, way), (one, other, "direct"))
                    self.assertLess(seconds, 1.0, f"{one} and {other}")

    def test_other_pairs_are_carried(self) -> None:
        """If hole punching is impossible, the public node relays, after at most 1.5 s."""
        for one, other in (("port", "sym"), ("sym", "port"), ("sym", "sym")):
            ground = self.ground()
            way, seconds = ways(ground, one, other)
            self.assertEqual((one, other, way), (one, other, "carried"))
            self.assertLess(seconds, 1.5, f"{one} and {other}")
            a, b = ground.nodes["a2"], ground.nodes["b2"]
            for asker, asked in ((a, b), (b, a)):
                self.assertEqual(ground.call(asker, ground.met_at(asked))[0], 7)


class WeatherTests(GroundCase):
    """Paths under loss and behind difficult routers."""

    def test_lossy_links(self) -> None:
        """At 30 % loss on both links, at least 38 of 40 pairs connect within 5 s, punched or relayed."""
        late = []
        pairs = [("port", "port"), ("full", "addr"), ("port", "sym"), ("none", "port")]
        for seed in range(10):
            for one, other in pairs:
                ground = self.ground(seed, LinkConditions(delay_s=0.015, loss=0.3))
                way, seconds = ways(ground, one, other)
                if seconds > 5.0:
                    late.append((seed, one, other, way, seconds))
        self.assertLessEqual(len(late), 2, late)

    def test_leaky_routers(self) -> None:
        """Routers that block a port after early datagrams are punched within 5 s from fresh ports."""
        for one, other in (("leaky", "leaky"), ("leaky", "port"), ("port", "leaky")):
            for delay_s in (0.015, 0.25):
                ground = self.ground()
                ground.site("b", other)
                ground.board.router_conditions[ground.routers["b"]] = LinkConditions(delay_s)
                _, seconds = ways(ground, one, other)
                self.assertLess(seconds, 5.0, f"{one} and {other}")
                ground.run(5.0)
                if delay_s < 0.1:
                    way = ground.way(ground.nodes["a2"], ground.nodes["b2"])
                    self.assertEqual((one, other, way), (one, other, "direct"))

    def test_late_words(self) -> None:
        """If one side is notified half a second late, the pair is relayed at first and has a direct path later."""
        for one, other in (("leaky", "port"), ("port", "leaky")):
            for late in "ab":
                ground = self.ground()
                ground.site("a", one)
                ground.site("b", other)
                host = ground.routers[late].host
                for port in range(6990, 7010):
                    ground.board.set_conditions(
                        ground.public, Address(host, port), LinkConditions(delay_s=0.5), one_way=True
                    )
                ways_seen = set()
                ways(ground, one, other)
                ground.run(20.0)
                for _ in range(20):
                    ground.run(1.0)
                    ways_seen.add(ground.way(ground.nodes["a2"], ground.nodes["b2"]))
                self.assertEqual((one, other, late, ways_seen), (one, other, late, {"direct"}))

    def test_routers_within_a_private_net(self) -> None:
        """Routers with a public side in a private network with the same prefix are punched like others."""
        for one, other, way in (("port", "port", "direct"), ("sym", "full", "direct"), ("sym", "sym", "carried")):
            ground = self.ground(nets=("10.0.9", "10.0"))
            self.assertEqual((one, other, ways(ground, one, other)[0]), (one, other, way))

    def test_a_router_restarts(self) -> None:
        """A node behind a router that restarts with new ports is reachable again within 5 s, also without traffic."""
        for one, other in (("port", "port"), ("full", "addr"), ("sym", "sym"), ("port", "none"), ("leaky", "port")):
            ground = self.ground()
            a = ground.at("a", one)
            ground.run(1.0)
            b = ground.at("b", other)
            ground.run(10.0)
            ground.routers["a"].rebind()
            self.assertLess(_reached_again(ground, a, b), 5.0, f"{one} and {other}")

    def test_mappings_are_held(self) -> None:
        """Behind routers with a mapping lifetime of 15 s two idle nodes keep their path open."""
        for one, other in (("port", "port"), ("sym", "sym")):
            ground = self.ground(lifetime=15.0)
            a, b = ground.at("a", one), ground.at("b", other)
            ground.run(60.0)
            to_b = a.overlay.members.get(b.identity.node_id)
            assert to_b is not None
            answer, seconds = ground.call(a, to_b)
            self.assertEqual(answer, 7)
            self.assertLess(seconds, 0.2)

    def test_everybody_hears_of_it(self) -> None:
        """In a large team, too, all members have the new address of an idle node after 5 s."""
        ground = self.ground()
        others = [ground.node(f"x{n}", Address(f"203.0.113.{150 + n}", 7000)) for n in range(32)]
        a = ground.at("a", "port")
        ground.run(21.0)
        ground.routers["a"].rebind()
        ground.run(5.0)
        seen = {peer.session.contact.address for other in others if (peer := _peer(other, a)) and peer.session}
        self.assertEqual(seen, {ground.met_at(a).address})
        self.assertNotEqual(seen, {Address(ground.routers["a"].host, 7000)})

    def test_fresh_ports_are_quiet(self) -> None:
        """Two nodes that met at fresh ports keep their session, and their ports do not count as new addresses."""
        ground = self.ground()
        ways(ground, "leaky", "leaky")
        a, b = ground.nodes["a2"], ground.nodes["b2"]
        ground.run(10.0)
        before = [peer and peer.session for peer in (_peer(a, b), _peer(b, a))]
        ground.run(30.0)
        self.assertEqual([peer and peer.session for peer in (_peer(a, b), _peer(b, a))], before)
        self.assertEqual((ground.way(a, b), ground.way(b, a)), ("direct", "direct"))
        peer = _peer(a, b)
        assert peer is not None and peer.session is not None
        at_b = peer.session.contact.address
        port = ground.networks["a2"].source_address(at_b).port
        self.assertIn(port, a.nat._additional_ports)
        a.nat.external.record(peer.session.contact, Address(ground.routers["a"].host, 3), is_change=True)
        self.assertEqual(len(a.endpoint.peers._handshakes), 0)
        a.nat._assign_port(peer, [at_b], 0)
        self.assertEqual(ground.networks["a2"].source_address(at_b).port, port)

    def test_direct_before_carried(self) -> None:
        """A relayed session does not replace a working direct one, but replaces a dead one."""
        ground = self.ground()
        a, b = ground.at("a", "none"), ground.at("b", "none")
        ground.run(3.0)
        a.call(b.contact, "echo", 1)
        ground.run(0.1)
        carried = Contact(b.identity.public, relayed_address(b.identity.node_id))
        for later, way in ((0.0, "direct"), (10.0, "carried")):
            if later:
                b.stop_silently()
                ground.run(later)
            keys = TransportKeys(bytes(32), bytes(32), bytes(32))
            session = Session(carried, 77 + int(later), 78, keys, ground.clock.seconds(), is_confirmed=True)
            a.endpoint.peers.add_session(session)
            self.assertEqual(ground.way(a, b), way)

    def test_another_address(self) -> None:
        """A node that moves to another network keeps its key and is reachable within 5 s."""
        ground = self.ground()
        a, b = ground.at("a", "port"), ground.at("b", "port")
        ground.run(5.0)
        ground.site("c", "port")
        ground.networks["a2"].router = ground.routers["c"]
        ground.board._ports[ground.routers["c"], a.contact.address] = ground.networks["a2"]
        self.assertLess(_reached_again(ground, b, a), 5.0)
        self.assertEqual(ground.met_at(a).address.host, ground.routers["c"].host)


class CarriedTests(GroundCase):
    """Pairs of nodes with a relayed path."""

    def carried(self, ground: Ground) -> tuple[EntangledNode, EntangledNode]:
        """Return two nodes that have no direct path and have been relayed for some seconds."""
        a = ground.at("a", "sym")
        ground.run(1.0)
        b = ground.at("b", "sym")
        ground.run(4.0)
        self.assertEqual((ground.way(a, b), ground.way(b, a)), ("carried", "carried"))
        return a, b

    def test_direct_as_soon_as_it_can_be(self) -> None:
        """A relayed pair can exchange large messages, and gets a direct path when its routers permit it."""
        ground = self.ground()
        a, b = self.carried(ground)
        session = a.endpoint.peers.find_session(b.identity.public)
        assert session is not None
        large, got = random.Random(1).randbytes(20_000), list[Any]()
        a.call(session.contact, "echo", large).addBoth(got.append)
        ground.run(5.0)
        self.assertEqual(got, [large])
        for router in ground.routers.values():
            router.kind = "port"
        ground.run(70.0)
        self.assertEqual((ground.way(a, b), ground.way(b, a)), ("direct", "direct"))
        carried = ground.nodes["pub"].endpoint.counters["carried"]
        self.assertEqual(ground.call(a, ground.met_at(b))[0], 7)
        ground.run(10.0)
        self.assertEqual(ground.nodes["pub"].endpoint.counters["carried"], carried)

    def test_any_member_carries(self) -> None:
        """If the relay fails at any moment, another member relays within 5 s."""
        for moment in range(8):
            ground = self.ground()
            ground.node("other", Address("203.0.113.200", 7000))
            a, b = self.carried(ground)
            to_b = a.overlay.members.get(b.identity.node_id)
            assert to_b is not None
            ground.run(moment / 4)
            ground.nodes["pub"].stop_silently()
            began = ground.clock.seconds()
            while ground.call(a, to_b)[0] != 7:
                self.assertLess(ground.clock.seconds() - began, 5.0)
            self.assertLess(ground.clock.seconds() - began, 5.0)

    def test_who_hears_of_it_reaches_it(self) -> None:
        """Other nodes reach a relayed peer directly if possible, otherwise through a relay."""
        ground = self.ground()
        _, b = self.carried(ground)
        for site, kind, way in (("c", "none", "direct"), ("d", "sym", "carried")):
            c = ground.at(site, kind)
            ground.run(2.5)
            self.assertEqual((kind, ground.way(c, b)), (kind, way))

    def test_who_named_it_is_asked(self) -> None:
        """For a peer with a relay address only, the caller asks the node that announced it for an introduction."""
        ground = self.ground()
        others = [ground.node(f"x{n}", Address(f"203.0.113.{150 + n}", 7000)) for n in range(16)]
        a = ground.at("a", "sym")
        ground.run(1.0)
        c = others[0]
        asked: list[bytes] = []
        for other in [ground.nodes["pub"], *others[1:]]:
            other.endpoint.expose("reach.introduce", _listening(other, asked), changes=True)
        b = ground.node("b", Address("203.0.113.220", 7000))
        ground.run(2.0)
        peers = c.endpoint.peers
        known = peers.get(b.identity.public)
        assert known is not None
        peers.evict(known)
        c.nat.selector.record_namer(Contact(b.identity.public, relayed_address(b.identity.node_id)), others[3].contact)
        asked.clear()
        answer, _ = ground.call(c, Contact(b.identity.public, relayed_address(b.identity.node_id)))
        self.assertEqual(answer, 7)
        self.assertIn(others[3].identity.node_id, asked[:3])
        self.assertEqual(ground.way(a, b), "direct")


def _peer(of: EntangledNode, other: EntangledNode) -> Peer | None:
    return of.endpoint.peers.get(other.identity.public)


def _listening(node: EntangledNode, asked: list[bytes]) -> Any:
    """Return the node's method, wrapped to record its calls."""
    answer = node.nat.introducer.answer_introduce

    def introduce(peer: Contact, wanted: bytes, candidates: list[object], order: int) -> Any:
        asked.append(node.identity.node_id)
        return answer(peer, wanted, candidates, order)

    return introduce


def _reached_again(ground: Ground, asked: EntangledNode, asker: EntangledNode) -> float:
    """Return the seconds until a call from ``asker`` to the known address of ``asked`` is answered."""
    began = ground.clock.seconds()
    while ground.clock.seconds() < began + 20.0:
        contact = asker.overlay.members.get(asked.identity.node_id) or ground.met_at(asked)
        if ground.call(asker, contact)[0] == 7:
            return ground.clock.seconds() - began
        ground.run(0.2)
    return float("inf")


class FreshPortTests(GroundCase):
    """Tests of ``FreshPorts`` on a node that does not need them."""

    def test_so_many_and_no_more(self) -> None:
        """At the limit a new port is opened only in place of the oldest one, after its hold time."""
        ground = self.ground()
        ports = ground.at("a", "none").nat._additional_ports
        opened = [ports.open() for _ in range(MAX_PORTS)]
        self.assertEqual((len(set(opened)), ports.open()), (MAX_PORTS, 0))
        ground.run(EXTENSION_S + 0.1)
        another = ports.open()
        self.assertNotEqual(another, 0)
        self.assertEqual(len(ports), MAX_PORTS)
        self.assertIn(another, ports)
        self.assertEqual([port in ports for port in opened], [False] + [True] * (MAX_PORTS - 1))

    def test_unused_ones_are_shut(self) -> None:
        """A fresh port without a session is closed after ``SHUT_S`` seconds."""
        ground = self.ground()
        reach = ground.at("a", "none").nat
        reach._open_port()
        ground.run(UNUSED_PORT_S - 1.0)
        self.assertEqual(len(reach._additional_ports), 1)
        ground.run(3.0)
        self.assertEqual(len(reach._additional_ports), 0)


OWN = Address("192.168.1.7", 8484)


class KindTests(SynchronousTestCase):
    """Tests of ``kind_of``."""

    def test_each_kind_of_address(self) -> None:
        """The address shows relayed, tunnelled and loopback paths; an introduced distant address counts as punched."""
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


class PassageTests(GroundCase):
    """Tests of ``Ways.passage`` with simulated routers."""

    def passage(self, a: EntangledNode, b: EntangledNode) -> PeerPath:
        """Return the path from ``a`` to ``b``."""
        return a.nat.paths.find_path(b.contact)

    def test_kinds(self) -> None:
        """Nodes behind cone routers are punched, behind symmetric routers relayed, and at one site use their LAN."""
        carrier = self.ground().nodes["pub"].identity.node_id
        for one, other, site, kind in (
            ("port", "port", "b", "punched"),
            ("sym", "sym", "b", "carried"),
            ("sym", "sym", "a", "lan"),
        ):
            ground = self.ground()
            a = ground.at("a", one)
            ground.run(2.0)
            b = ground.at(site, other, 3)
            self.assertEqual(self.passage(a, b), PeerPath("none"))
            ground.run(6.0)
            for near, far in ((a, b), (b, a)):
                passage = self.passage(near, far)
                self.assertEqual((passage.kind, passage.by), (kind, carrier if kind == "carried" else b""))
            self.assertEqual(self.passage(a, ground.nodes["pub"]).kind, "direct")

    def test_since(self) -> None:
        """The age of a path includes successive sessions; a lost path is removed."""
        ground = self.ground()
        a, pub = ground.nodes["pub"], ground.at("b", "none")
        began = ground.clock.seconds()
        ground.run(60.0)
        since = self.passage(a, pub).since
        assert since is not None
        self.assertLess(abs(since - began), 1.0)
        a.endpoint.reopen(pub.contact)
        ground.run(10.0)
        self.assertEqual(self.passage(a, pub).since, since)
        pub.stop_silently()
        ground.run(60.0)
        self.assertNotIn(pub.identity.public, a.nat.paths._path_kinds)
