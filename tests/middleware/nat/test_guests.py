"""Tests of the limits of introductions, and of nodes that need no introductions."""

from __future__ import annotations

from typing import Any

from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.clock import HeapClock
from middleware.entangled.contact import Contact
from middleware.entangled.errors import Refused
from middleware.entangled.identity import Identity
from middleware.entangled.nat.candidate import MAX_CANDIDATES, is_loopback, is_near, pack_candidates, parse_candidates
from middleware.entangled.nat.introducer import ATTEMPT_BURST, ATTEMPTS_PER_S, INTRODUCTIONS_PER_S, IntroductionLimits
from middleware.entangled.network.network import Address, relayed_address
from middleware.entangled.network.switchboard import LinkConditions
from tests.middleware.nat.sites import SitesCase

INTRODUCE, MEET = "reach.introduce", "reach.meet"


class QuietTests(SitesCase):
    """Nodes with direct paths cause no traffic for introductions."""

    def test_neighbours_ask_nobody(self) -> None:
        """Nodes on one LAN use no introduction, address request, relay or timer, even if a node fails."""
        sites = self.sites(conditions=LinkConditions(delay_s=0.001))
        asked: list[bytes] = []
        sites.nodes["pub"].stop_silently()
        nodes = [sites.node(f"n{n}", Address(f"192.168.7.{9 + n}", 7000)) for n in range(4)]
        first = nodes[0]
        for node in nodes:
            node.join([first.contact.address])
            node.endpoint.expose(INTRODUCE, lambda peer, *rest: asked.append(b""), changes=True)
        sites.run(5.0)
        self.assertEqual(len(first.overlay.contacts()), 3)
        nodes[3].stop_silently()
        sites.run(30.0)
        self.assertEqual(asked, [])
        for node in nodes[:3]:
            self.assertFalse(node.nat._upgrades or node.nat._additional_ports or node.nat._is_maintenance_scheduled)
            self.assertEqual(len(node.nat.relay), 0)

    def test_answered_at_once(self) -> None:
        """A node that replies immediately is never introduced, at any distance."""
        sites = self.sites()
        a = sites.at("a", "none")
        b = sites.at("b", "none")
        asked: list[bytes] = []
        sites.nodes["pub"].endpoint.expose(INTRODUCE, lambda peer, *rest: asked.append(b""), changes=True)
        sites.run(20.0)
        self.assertEqual((sites.way(a, b), asked), ("direct", []))


class HostileTests(SitesCase):
    """Attacks by members that send false addresses or too many requests."""

    def setUp(self) -> None:
        """Create a public node and two nodes that know it."""
        self.g = self.sites()
        self.a, self.b = self.g.at("a", "none"), self.g.at("b", "none")
        self.g.run(3.0)

    def asked(self, method: str, *arguments: object) -> Any:
        """Return the result of a request from ``a`` to ``b``."""
        got: list[Any] = []
        self.a.call(self.g.met_at(self.b), method, *arguments, changes=True).addBoth(got.append)
        self.g.run(1.5)
        return getattr(got[0], "value", got[0])

    def test_odd_questions(self) -> None:
        """Invalid requests are rejected or get an empty result, without an exception."""
        stranger = Identity(b"s" * 32)
        odd: list[tuple[object, ...]] = [(b"", [], 0), (b"x", [], 0), (bytes(20), "x", 0), (bytes(20), [], None)]
        for arguments in odd:
            self.assertIsInstance(self.asked(INTRODUCE, *arguments), Refused)
        self.assertIsNone(self.asked(INTRODUCE, stranger.node_id, [[7], None, ["x", 1]], 77))
        self.assertIsInstance(self.asked(MEET, self.b.identity.public, [["203.0.113.77", 7]], 0), Refused)
        for public in (b"", b"x", bytes(32), b"\xff" * 32):
            answer = self.asked(MEET, public, [["203.0.113.77", 7], 3, ["0.0.0.0", 1]], 3)
            self.assertTrue(isinstance(answer, Refused | list), repr(answer))
        for host, port in (("x", 1), ("203.0.113.5", -1), ("~" + "0" * 40, 1), ("203.0.113.5", 70000)):
            self.a.endpoint.notify(self.g.met_at(self.b), "reach.seen", host, port)
        self.g.run(1.0)
        self.assertEqual(self.flushLoggedErrors(), [])
        self.assertEqual(self.asked("echo", 3), 3)

    def test_liars_are_outdone(self) -> None:
        """An introducer that returns false addresses does not prevent a connection through other introducers."""
        made_up = [[f"203.0.114.{n}", 7000] for n in range(20)]
        self.a.endpoint.expose(INTRODUCE, lambda peer, *rest: [made_up, [], True], changes=True)
        c = self.g.at("c", "port")
        d = self.g.at("d", "port")
        self.g.run(6.0)
        self.assertNotEqual((self.g.way(c, d), self.g.way(d, c)), ("none", "none"))
        contact = c.overlay.members.get(d.identity.node_id)
        assert contact is not None
        self.assertEqual(self.g.call(c, contact)[0], 7)

    def test_nobody_to_ask(self) -> None:
        """If no peer knows a relayed node, a call to this node fails like any unanswered call and leaves no state."""
        stranger = Identity(b"s" * 32)
        answer, seconds = self.g.call(self.a, Contact(stranger.public, relayed_address(stranger.node_id)))
        self.assertIn("no answer", str(answer))
        self.assertLess(seconds, 2.0)
        odd = Contact(stranger.public, Address("~" + "z" * 40, 1))
        self.assertIn("no answer", str(self.g.call(self.a, odd)[0]))
        self.g.run(6.0)
        self.assertEqual(len(self.a.endpoint.peers._handshakes), 0)

    def test_outside(self) -> None:
        """Two peers observe two different ports of a node behind a symmetric router, and the same port otherwise."""
        for site, kind, ports in (("c", "port", 1), ("d", "sym", 2)):
            c = self.g.at(site, kind)
            self.g.run(2.0)
            self.assertGreaterEqual(len({address.port for address in c.nat.external.addresses}), ports)
            self.assertEqual({address.host for address in c.nat.external.addresses}, {self.g.routers[site].host})


ASKER, OTHER, STRANGER = b"a" * 32, b"o" * 32, b"s" * 32


class IntroductionLimitsTests(SynchronousTestCase):
    """Tests of ``IntroductionLimits``."""

    def setUp(self) -> None:
        """Create unused introduction limits."""
        self.clock = HeapClock()
        self.allowance = IntroductionLimits(self.clock)

    def test_each_peer_has_its_own(self) -> None:
        """A peer that has used up its introductions must wait for the next; other peers are not affected."""
        granted = [self.allowance.may_introduce(ASKER) for _ in range(int(2 * INTRODUCTIONS_PER_S) + 1)]
        self.assertEqual((sum(granted), granted[-1]), (2 * INTRODUCTIONS_PER_S, False))
        self.assertTrue(self.allowance.may_introduce(OTHER))
        self.assertTrue(self.allowance.may_meet(ASKER))
        self.clock.advance(1.01 / INTRODUCTIONS_PER_S)
        self.assertEqual([self.allowance.may_introduce(ASKER) for _ in range(2)], [True, False])

    def test_who_is_met_does_not_count(self) -> None:
        """If an introduced peer replies, its introducer may make one more introduction.

        Unanswered introductions become available again at a fixed rate.
        """
        while self.allowance.may_meet(ASKER):
            self.allowance.record_introducer(STRANGER, ASKER)
        for public, again in ((OTHER, False), (STRANGER, True), (STRANGER, False)):
            self.allowance.refund(public)
            self.assertEqual(self.allowance.may_meet(ASKER), again)
        self.clock.advance(2 * ATTEMPT_BURST / ATTEMPTS_PER_S)
        granted = [self.allowance.may_meet(ASKER) for _ in range(int(2 * ATTEMPT_BURST))]
        self.assertEqual(sum(granted), ATTEMPT_BURST)


class CandidateTests(SynchronousTestCase):
    """Tests of the functions of ``candidate``."""

    def test_there_and_back(self) -> None:
        """IPv4 and IPv6 addresses survive packing without duplicates, up to ``MAX_CANDIDATES``."""
        addresses = [Address("203.0.113.1", 7000), Address("2001:db8::1", 1), Address("192.168.1.2", 65535)]
        self.assertEqual(parse_candidates(pack_candidates([*addresses, *addresses])), addresses)
        many = [Address("203.0.113.1", port) for port in range(1, 50)]
        self.assertEqual(parse_candidates([list(address) for address in many]), many[:MAX_CANDIDATES])

    def test_what_no_peer_can_have(self) -> None:
        """Multicast, wildcard, broadcast, host name and relay addresses, invalid ports and other input are ignored."""
        hosts = ["224.0.0.1", "ff02::1", "0.0.0.0", "::", "255.255.255.255", "localhost", "~" + "0" * 40, "", "1" * 99]
        for host in hosts:
            self.assertEqual(parse_candidates([[host, 7000]]), [], host)
        odd: list[object] = [None, 7, "x", [7], [[]], [["203.0.113.1"]], [["203.0.113.1", 0]], [["203.0.113.1", "7"]]]
        for fields in odd:
            self.assertEqual(parse_candidates(fields), [], repr(fields))
        self.assertEqual(parse_candidates([["203.0.113.1", 65536], [b"203.0.113.1", 1], ["203.0.113.1", True]]), [])

    def test_near(self) -> None:
        """Hosts on one machine or in one private network are near; public hosts and other networks are not near."""
        near = [("127.0.0.1", "192.168.1.2"), ("192.168.1.9", "192.168.1.2"), ("10.0.7.1", "10.0.9.1")]
        near += [("203.0.113.1", "203.0.113.1"), ("fe80::1", "fe80::2"), ("fd00::1", "fd00::2")]
        far = [("203.0.113.1", "203.0.113.2"), ("192.168.1.2", "10.0.0.1"), ("192.168.1.2", "192.169.1.2")]
        far += [("10.1.0.1", "10.2.0.1"), ("2001:db8::1", "2001:db8::2"), ("::ffff", "1.2.3.4"), ("x", "127.0.0.1")]
        self.assertEqual([pair for pair in near if not is_near(*pair)], [])
        self.assertEqual([pair for pair in far if is_near(*pair)], [])
        self.assertEqual(
            [is_loopback(host) for host in ("127.0.0.9", "::1", "10.0.0.1", "x")], [True, True, False, False]
        )
        self.assertFalse(is_near("10.0.7.1", "10.0.9.1", is_translated=True))
        self.assertTrue(is_near("10.0.9.7", "10.0.9.1", is_translated=True))
