"""Tests of the simulated NAT routers, which map and filter by their NAT type."""

from __future__ import annotations

import random

from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.clock import HeapClock
from middleware.entangled.network.nat_router import NatKind, NatRouter
from middleware.entangled.network.network import Address
from middleware.entangled.network.switchboard import LinkConditions, Switchboard

INSIDE = Address("192.168.1.2", 7000)
HOST = "203.0.113.9"
A, A2, B = Address("203.0.113.1", 1), Address("203.0.113.1", 2), Address("203.0.113.2", 1)


def nat(kind: NatKind) -> NatRouter:
    """Return a router of this NAT type."""
    return NatRouter(kind, HOST, random.Random(3))


class NatTests(SynchronousTestCase):
    """Tests of ``NatRouter``."""

    def test_what_each_kind_lets_in(self) -> None:
        """After a datagram to A, the NAT type decides whether A, another port of its host or another host may reply."""
        kinds: list[tuple[NatKind, list[bool]]] = [
            ("full", [True, True, True]),
            ("addr", [True, True, False]),
            ("port", [True, False, False]),
            ("leaky", [True, False, False]),
            ("sym", [True, False, False]),
            ("noudp", [False, False, False]),
        ]
        for kind, expected in kinds:
            router = nat(kind)
            outside = router.translate_outgoing(INSIDE, A, 0.0)
            port = outside.port if outside is not None else INSIDE.port
            self.assertEqual(
                [router.translate_incoming(source, port, 0.0) == INSIDE for source in (A, A2, B)], expected, kind
            )

    def test_symmetric_ports_differ(self) -> None:
        """A symmetric router uses a different port for each destination, and keeps it.

        Other types use one port for all.
        """
        kinds: list[tuple[NatKind, int]] = [("sym", 2), ("port", 1)]
        for kind, count in kinds:
            router = nat(kind)
            a, b, again = (router.translate_outgoing(INSIDE, to, 0.0) for to in (A, B, A))
            self.assertEqual((a, len({a, b})), (again, count))

    def test_mappings_end(self) -> None:
        """Traffic in either direction keeps a mapping open; after a restart the router creates a new mapping."""
        router = NatRouter("port", HOST, random.Random(3), 10.0)
        outside = router.translate_outgoing(INSIDE, A, 0.0)
        assert outside is not None
        passed = [router.translate_incoming(A, outside.port, moment) for moment in (9.0, 18.0, 29.0)]
        self.assertEqual(passed, [INSIDE, INSIDE, None])
        before = router.translate_outgoing(INSIDE, A, 30.0)
        router.rebind()
        assert before is not None
        self.assertIsNone(router.translate_incoming(A, before.port, 31.0))
        self.assertNotEqual(router.translate_outgoing(INSIDE, A, 31.0), before)

    def test_leaky_ports_are_burnt(self) -> None:
        """A leaky router changes the port for a destination that sent a datagram too early, and for no other."""
        router = nat("leaky")
        before = router.translate_outgoing(INSIDE, A, 0.0)
        assert before is not None
        self.assertIsNone(router.translate_incoming(B, before.port, 1.0))
        self.assertNotEqual(router.translate_outgoing(INSIDE, B, 1.0), before)
        self.assertEqual(router.translate_outgoing(INSIDE, A, 1.0), before)

    def test_on_the_board(self) -> None:
        """Nodes behind one router reach each other at their private addresses, but not at the public address."""
        clock = HeapClock()
        switchboard = Switchboard(clock, random.Random(1))
        router = switchboard.add_router(nat("full"), LinkConditions(delay_s=0.5))
        got: list[tuple[float, bytes, Address]] = []
        one, other = (switchboard.make_network(f"192.168.1.{n}", 7000, home=router) for n in (2, 3))
        far = switchboard.make_network(*B)
        for network in (one, other, far):
            network.listen(lambda datagram, source: got.append((clock.seconds(), datagram, source)))
        one.send(b"near", other.address)
        one.send(b"far", B)
        clock.advance(1.0)
        shown = Address(HOST, 7000)
        self.assertEqual(got, [(0.0, b"near", one.address), (0.5, b"far", shown)])
        other.send(b"hairpin", shown)
        far.send(b"back", shown)
        far.send(b"private", one.address)
        clock.advance(1.0)
        self.assertEqual([datagram for _, datagram, _ in got[2:]], [b"back"])
        self.assertEqual((switchboard.counters["blocked"], switchboard.counters["unheard"]), (1, 1))

    def test_further_ports_on_the_board(self) -> None:
        """An additional port has a separate mapping.

        Replies to a source that sent to this port are sent from this port.
        """
        clock = HeapClock()
        switchboard = Switchboard(clock, random.Random(1))
        router = switchboard.add_router(nat("full"))
        one, far = switchboard.make_network(*INSIDE, home=router), switchboard.make_network(*B)
        sources: list[Address] = []
        one.listen(lambda datagram, source: one.send(datagram, source))
        far.listen(lambda datagram, source: sources.append(source))
        port = one.open_port()
        self.assertEqual(one.assign_port(B, port), 0)
        one.send(b"x", B)
        clock.advance(0.0)
        self.assertEqual(sources, [Address(HOST, port)])
        third = switchboard.make_network(*A)
        third.listen(lambda datagram, source: sources.append(source))
        third.send(b"y", Address(HOST, port))
        clock.advance(0.0)
        one.close_port(port)
        self.assertEqual(sources[1:], [Address(HOST, port)])
        self.assertEqual((one.assign_port(B, 0), one.source_address(B)), (0, INSIDE))
