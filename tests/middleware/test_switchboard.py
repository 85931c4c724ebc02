"""Tests of the simulated network."""

from __future__ import annotations

import random

from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.clock import HeapClock
from middleware.entangled.errors import PortInUse
from middleware.entangled.network.network import MAX_RELAYED_BYTES, Address, Network
from middleware.entangled.network.switchboard import LinkConditions, Switchboard


class _Far:
    """A link that delays each datagram by 2 s, duplicates it and records it."""

    def __init__(self) -> None:
        self.asked: list[tuple[Address, Address, int, float]] = []

    def draw_delays(self, source: Address, to: Address, size: int, now: float, rng: random.Random) -> list[float]:
        self.asked.append((source, to, size, now))
        return [2.0, 2.0]


class SwitchboardTests(SynchronousTestCase):
    """Tests of ``Switchboard``."""

    def setUp(self) -> None:
        """Create two networks."""
        self.clock = HeapClock()
        self.switchboard = Switchboard(self.clock, random.Random(3))
        self.got: list[tuple[float, bytes]] = []
        self.a = self.switchboard.make_network()
        self.b = self.switchboard.make_network()
        self.a.listen(self._receive)
        self.b.listen(self._receive)

    def _receive(self, datagram: bytes, source: Address) -> None:
        self.got.append((self.clock.seconds(), datagram))

    def _send(self, count: int) -> None:
        for number in range(count):
            self.a.send(b"%d" % number, self.b.address)
        self.clock.advance(1)

    def test_delivers_later_and_in_order(self) -> None:
        """Datagrams arrive asynchronously and in order.

        An oversized datagram, or one to an unused address, is dropped.
        """
        network: Network = self.a
        self.a.send(bytes(MAX_RELAYED_BYTES + 1), self.b.address)
        self.a.send(b"x", Address("127.0.0.1", 9))
        network.send(b"x", self.b.address)
        self.assertEqual(self.got, [])
        self._send(3)
        self.assertEqual([datagram for _, datagram in self.got], [b"x", b"0", b"1", b"2"])
        self.assertEqual((self.switchboard.counters["oversized"], self.switchboard.counters["unheard"]), (1, 1))

    def test_loses_doubles_and_delays(self) -> None:
        """Loss, duplication, delay and jitter match the configured ``LinkConditions``."""
        self.switchboard.conditions = LinkConditions(delay_s=0.1, jitter_s=0.02, loss=0.2, duplicate=0.1, reorder=0.1)
        self._send(5000)
        self.assertApproximates(self.switchboard.counters["lost"] / 5000, 0.2, 0.02)
        self.assertApproximates(self.switchboard.counters["duplicated"] / 4000, 0.1, 0.02)
        self.assertEqual(len(self.got), self.switchboard.counters["delivered"])
        late = [moment for moment, _ in self.got if moment > 0.12]
        self.assertGreaterEqual(min(self.got)[0], 0.08)
        self.assertApproximates(len(late) / len(self.got), 0.1, 0.02)

    def test_cut_one_way(self) -> None:
        """Until ``heal``, a one-way cut and a barrier drop all datagrams in one direction, also those in transit."""
        for close in (
            lambda: self.switchboard.cut(self.a.address, self.b.address, one_way=True),
            lambda: self.switchboard.barriers.append(lambda source, to: source == self.a.address),
        ):
            self.setUp()
            self.switchboard.conditions = LinkConditions(delay_s=0.1)
            self.a.send(b"on its way", self.b.address)
            close()
            self.b.send(b"back", self.a.address)
            self._send(1)
            self.assertEqual([datagram for _, datagram in self.got], [b"back"])
            self.assertEqual(self.switchboard.counters["cut"], 2)
            self.switchboard.heal()
            self._send(1)
            self.assertEqual(len(self.got), 2)

    def test_partition(self) -> None:
        """Groups are isolated from each other; all addresses without a group form one further group."""
        c = self.switchboard.make_network()
        c.listen(self._receive)
        self.switchboard.partition([self.a.address], [self.b.address])
        self._send(1)
        c.send(b"c", self.b.address)
        self.clock.advance(1)
        self.assertEqual(self.got, [])
        self.switchboard.partition([self.a.address, self.b.address])
        self._send(1)
        self.assertEqual(len(self.got), 1)

    def test_killed_network_is_deaf_and_mute(self) -> None:
        """A killed network neither sends nor receives, and a new network can use its address."""
        self.switchboard.kill(self.b.address)
        self._send(1)
        self.b.send(b"ghost", self.a.address)
        self.clock.advance(1)
        self.assertEqual(self.got, [])
        reborn = self.switchboard.make_network(*self.b.address)
        reborn.listen(self._receive)
        self._send(1)
        self.assertEqual(len(self.got), 1)

    def test_port_is_held_once(self) -> None:
        """A second network cannot listen on an address in use.

        After ``close``, which can be repeated, it can listen.
        """
        twin = self.switchboard.make_network(*self.b.address)
        self.assertRaises(PortInUse, twin.listen, self._receive)
        self.b.close()
        self.b.close()
        twin.listen(self._receive)

    def test_link_says_how_long_everything_takes(self) -> None:
        """A link sets the delay of each datagram, except in a direction that has separate ``LinkConditions``."""
        link = self.switchboard.link_model = _Far()
        self.clock.advance(5)
        self.a.send(b"far", self.b.address)
        self.assertEqual(link.asked, [(self.a.address, self.b.address, 3, 5.0)])
        self.switchboard.set_conditions(self.a.address, self.b.address, LinkConditions(delay_s=0.5), one_way=True)
        self.a.send(b"near", self.b.address)
        self.clock.advance(3)
        self.assertEqual(self.got, [(5.5, b"near"), (7.0, b"far"), (7.0, b"far")])
        self.assertEqual((len(link.asked), self.switchboard.counters["duplicated"]), (1, 1))
        self.b.send(b"back", self.a.address)
        self.switchboard.set_conditions(self.a.address, self.b.address, None)
        self.a.send(b"far", self.b.address)
        self.assertEqual(len(link.asked), 3)

    def test_traffic_goes_on_in_the_next_life(self) -> None:
        """Datagrams and bytes are counted at both ends, and a later network can continue the counters."""
        self.switchboard.conditions = LinkConditions(loss=1.0)
        self.a.send(b"lost", self.b.address)
        self.switchboard.conditions = LinkConditions()
        self._send(3)
        sent, received = self.a.traffic, self.b.traffic
        self.assertEqual((sent.sent, sent.sent_bytes, sent.received, sent.received_bytes), (4, 7, 0, 0))
        self.assertEqual((received.sent, received.received, received.received_bytes), (0, 3, 3))
        self.a.close()
        self.a = self.switchboard.make_network(*self.a.address, traffic=sent)
        self.a.listen(self._receive)
        self._send(1)
        self.assertEqual((self.a.traffic.sent, self.a.traffic.sent_bytes), (5, 8))

    def test_digest_is_that_of_every_delivery(self) -> None:
        """The seed determines the digest of all deliveries, which does not depend on earlier queries of the digest."""

        def run(seed: int, is_asked_often: bool) -> str:
            clock = HeapClock()
            switchboard = Switchboard(clock, random.Random(seed), LinkConditions(loss=0.1, duplicate=0.1))
            a, b = switchboard.make_network(), switchboard.make_network()
            b.listen(lambda datagram, source: b.send(datagram + b"!", source))
            a.listen(lambda datagram, source: None)
            for number in range(700):
                a.send(b"%d" % number, b.address)
                if is_asked_often:
                    switchboard.digest()
                clock.advance(0.001)
            return switchboard.digest()

        self.assertEqual(run(1, False), run(1, True))
        self.assertNotEqual(run(1, False), run(2, False))
