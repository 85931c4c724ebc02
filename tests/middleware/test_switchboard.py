"""Tests of the networks in memory."""

from __future__ import annotations

import random

from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.clock import HeapClock
from middleware.entangled.errors import PortInUse
from middleware.entangled.network.network import MAX_DATAGRAM, Address, Network
from middleware.entangled.network.switchboard import Switchboard, Weather


class SwitchboardTests(SynchronousTestCase):
    """Behaviour of ``Switchboard``."""

    def setUp(self) -> None:
        """Join two networks."""
        self.clock = HeapClock()
        self.board = Switchboard(self.clock, random.Random(3))
        self.got: list[tuple[float, bytes]] = []
        self.a = self.board.network()
        self.b = self.board.network()
        self.a.listen(self._receive)
        self.b.listen(self._receive)

    def _receive(self, datagram: bytes, source: Address) -> None:
        self.got.append((self.clock.seconds(), datagram))

    def _send(self, count: int) -> None:
        for number in range(count):
            self.a.send(b"%d" % number, self.b.address)
        self.clock.advance(1)

    def test_delivers_later_and_in_order(self) -> None:
        """Even without delay a datagram arrives after the sender is done, and in the order of sending."""
        network: Network = self.a
        network.send(b"x", self.b.address)
        self.assertEqual(self.got, [])
        self._send(3)
        self.assertEqual([datagram for _, datagram in self.got], [b"x", b"0", b"1", b"2"])

    def test_loses_doubles_and_delays(self) -> None:
        """Loss, duplication, delay and jitter come as the weather says."""
        self.board.weather = Weather(delay_s=0.1, jitter_s=0.02, loss=0.2, duplicate=0.1, reorder=0.1)
        self._send(5000)
        self.assertApproximates(self.board.counters["lost"] / 5000, 0.2, 0.02)
        self.assertApproximates(self.board.counters["duplicated"] / 4000, 0.1, 0.02)
        self.assertEqual(len(self.got), self.board.counters["delivered"])
        late = [moment for moment, _ in self.got if moment > 0.12]
        self.assertGreaterEqual(min(self.got)[0], 0.08)
        self.assertApproximates(len(late) / len(self.got), 0.1, 0.02)

    def test_link_has_its_own_weather(self) -> None:
        """A weather given to one direction of one link holds there alone, until it is taken back."""
        self.board.set_weather(self.a.address, self.b.address, Weather(loss=1.0), one_way=True)
        self._send(5)
        self.b.send(b"back", self.a.address)
        self.clock.advance(1)
        self.assertEqual([datagram for _, datagram in self.got], [b"back"])
        self.board.set_weather(self.a.address, self.b.address, None)
        self._send(1)
        self.assertEqual(len(self.got), 2)

    def test_cut_one_way(self) -> None:
        """A one-way cut stops one direction, what is on its way included; healing opens it."""
        self.board.weather = Weather(delay_s=0.1)
        self.a.send(b"on its way", self.b.address)
        self.board.cut(self.a.address, self.b.address, one_way=True)
        self.b.send(b"back", self.a.address)
        self._send(1)
        self.assertEqual([datagram for _, datagram in self.got], [b"back"])
        self.board.heal()
        self._send(1)
        self.assertEqual(len(self.got), 2)

    def test_partition(self) -> None:
        """Nothing passes between groups, and who is named in none is with the others who are not."""
        c = self.board.network()
        c.listen(self._receive)
        self.board.partition([self.a.address], [self.b.address])
        self._send(1)
        c.send(b"c", self.b.address)
        self.clock.advance(1)
        self.assertEqual(self.got, [])
        self.board.partition([self.a.address, self.b.address])
        self._send(1)
        self.assertEqual(len(self.got), 1)

    def test_killed_network_is_deaf_and_mute(self) -> None:
        """A killed network neither sends nor receives, and its address may be taken by another one."""
        self.board.kill(self.b.address)
        self._send(1)
        self.b.send(b"ghost", self.a.address)
        self.clock.advance(1)
        self.assertEqual(self.got, [])
        reborn = self.board.network(*self.b.address)
        reborn.listen(self._receive)
        self._send(1)
        self.assertEqual(len(self.got), 1)

    def test_port_is_held_once(self) -> None:
        """A second network at an address that is listened to is refused; after closing, twice even, it is free."""
        twin = self.board.network(*self.b.address)
        self.assertRaises(PortInUse, twin.listen, self._receive)
        self.b.close()
        self.b.close()
        twin.listen(self._receive)

    def test_drops_what_is_too_large_or_unheard(self) -> None:
        """A datagram over the limit, and one to nobody, are counted and lost."""
        self.a.send(bytes(MAX_DATAGRAM + 1), self.b.address)
        self.a.send(b"x", Address("127.0.0.1", 9))
        self.clock.advance(1)
        self.assertEqual((self.board.counters["oversized"], self.board.counters["unheard"], self.got), (1, 1, []))

    def test_digest_follows_the_seed(self) -> None:
        """The same seed gives the same digest, another seed another one."""

        def run(seed: int) -> str:
            clock = HeapClock()
            board = Switchboard(clock, random.Random(seed), Weather(0.01, 0.005, 0.1, 0.1, 0.1))
            a, b = board.network(), board.network()
            b.listen(lambda datagram, source: b.send(datagram + b"!", source))
            a.listen(lambda datagram, source: None)
            for number in range(50):
                a.send(b"%d" % number, b.address)
            clock.advance(1)
            return board.digest()

        self.assertEqual(run(1), run(1))
        self.assertNotEqual(run(1), run(2))
