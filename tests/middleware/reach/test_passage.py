"""Tests of how a way is called, and since when it is that one."""

from __future__ import annotations

from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.network.network import Address, relayed
from middleware.entangled.node import EntangledNode
from middleware.entangled.reach.passage import Passage, kind_of
from tests.middleware.reach.ground import Ground, GroundCase

OWN = Address("192.168.1.7", 8484)


class KindTests(SynchronousTestCase):
    """Behaviour of ``kind_of``."""

    def test_each_kind_of_address(self) -> None:
        """What carries, tunnels and loops back shows in the address; a neighbour is on the LAN, others are far."""
        kinds = {
            "carried": relayed(bytes(20)),
            "tunnel": Address("~wss-0123456789ab", 1),
            "machine": Address("127.0.0.1", 7000),
            "lan": Address("192.168.1.9", 8484),
            "direct": Address("203.0.113.9", 8484),
        }
        self.assertEqual([kind_of(address, OWN, False, False) for address in kinds.values()], list(kinds))
        self.assertEqual(kind_of(OWN, OWN, False, False), "machine")

    def test_only_what_is_far_is_punched(self) -> None:
        """Who was introduced and is reached in the own network needs no hole; who is far has one."""
        self.assertEqual(kind_of(Address("192.168.1.9", 8484), OWN, False, True), "lan")
        self.assertEqual(kind_of(Address("203.0.113.9", 8484), OWN, False, True), "punched")


class PassageTests(GroundCase):
    """Behaviour of ``Ways.passage``, over routers in memory."""

    def passage(self, a: EntangledNode, b: EntangledNode) -> Passage:
        """How one reaches the other."""
        return a.reach.ways.passage(b.contact)

    def pair(self, ground: Ground, one: str, other: str) -> tuple[EntangledNode, EntangledNode]:
        """Two nodes behind routers, when they have met."""
        a = ground.at("a", one)
        ground.run(2.0)
        b = ground.at("b", other)
        ground.run(6.0)
        return a, b

    def test_punched(self) -> None:
        """Two behind cone routers are punched, on both sides; the public node is reached directly."""
        ground = self.ground()
        a, b = self.pair(ground, "port", "port")
        self.assertEqual((self.passage(a, b).kind, self.passage(b, a).kind), ("punched", "punched"))
        self.assertEqual(self.passage(a, ground.nodes["pub"]).kind, "direct")

    def test_carried(self) -> None:
        """Two behind symmetric routers are carried, and it is said by whom."""
        ground = self.ground()
        a, b = self.pair(ground, "sym", "sym")
        carrier = ground.nodes["pub"].identity.node_id
        for one, other in ((a, b), (b, a)):
            passage = self.passage(one, other)
            self.assertEqual((passage.kind, passage.by), ("carried", carrier))

    def test_neighbours(self) -> None:
        """Two of one site reach each other on their LAN, whatever the router is."""
        ground = self.ground()
        a = ground.at("a", "sym", 2)
        ground.run(2.0)
        neighbour = ground.at("a", "sym", 3)
        ground.run(6.0)
        self.assertEqual((self.passage(a, neighbour).kind, self.passage(neighbour, a).kind), ("lan", "lan"))

    def test_since(self) -> None:
        """A way is as old as it is, whatever sessions succeed each other; one that was lost begins anew."""
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
        pub.vanish()
        ground.run(60.0)
        self.assertNotIn(pub.identity.public, a.reach.ways._passages)

    def test_no_way(self) -> None:
        """Who was never met is reached by no way."""
        ground = self.ground()
        a = ground.at("a", "none")
        ground.run(2.0)
        stranger = ground.at("b", "sym")
        self.assertEqual(self.passage(a, stranger), Passage("none"))
