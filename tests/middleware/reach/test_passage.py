"""Tests of how a way is called, and since when it is that one."""

from __future__ import annotations

from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.network.network import Address, relayed
from middleware.entangled.node import EntangledNode
from middleware.entangled.reach.passage import Passage, kind_of
from tests.middleware.reach.ground import GroundCase

OWN = Address("192.168.1.7", 8484)


class KindTests(SynchronousTestCase):
    """Behaviour of ``kind_of``."""

    def test_each_kind_of_address(self) -> None:
        """Who carries, tunnels or loops back shows in the address; a far one that was introduced is punched."""
        kinds = {
            "carried": relayed(bytes(20)),
            "tunnel": Address("~wss-0123456789ab", 1),
            "machine": Address("127.0.0.1", 7000),
            "lan": Address("192.168.1.9", 8484),
            "direct": Address("203.0.113.9", 8484),
        }
        self.assertEqual([kind_of(address, OWN, False, False) for address in kinds.values()], list(kinds))
        self.assertEqual(kind_of(OWN, OWN, False, False), "machine")
        introduced = [kind_of(kinds[kind], OWN, False, True) for kind in ("lan", "direct")]
        self.assertEqual(introduced, ["lan", "punched"])


class PassageTests(GroundCase):
    """Behaviour of ``Ways.passage``, over routers in memory."""

    def passage(self, a: EntangledNode, b: EntangledNode) -> Passage:
        """How one reaches the other."""
        return a.reach.ways.passage(b.contact)

    def test_kinds(self) -> None:
        """Two behind cone routers are punched, two behind symmetric ones carried, two of one site on their LAN."""
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
            self.assertEqual(self.passage(a, b), Passage("none"))
            ground.run(6.0)
            for near, far in ((a, b), (b, a)):
                passage = self.passage(near, far)
                self.assertEqual((passage.kind, passage.by), (kind, carrier if kind == "carried" else b""))
            self.assertEqual(self.passage(a, ground.nodes["pub"]).kind, "direct")

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
