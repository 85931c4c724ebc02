"""Tests of ``middleware.faults.network``: fault injection into one node's network."""

from __future__ import annotations

import random

from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.clock import HeapClock
from middleware.entangled.network.switchboard import PERFECT, LinkConditions, Switchboard
from middleware.faults.network import FaultyNetwork


class FaultyNetworkTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.clock = HeapClock()
        switchboard = Switchboard(self.clock, random.Random(1))
        self.network = FaultyNetwork(switchboard.make_network(), self.clock, random.Random(2))
        self.other = switchboard.make_network()
        self.came: list[bytes] = []
        self.answers: list[bytes] = []
        self.network.listen(lambda datagram, source: self.came.append(datagram))
        self.other.listen(lambda datagram, source: self.answers.append(datagram))

    def exchange(self, seconds: float = 0.01, times: int = 1) -> tuple[int, int]:
        """Send ``times`` datagrams in each direction; return how many the node and its peer received."""
        before = len(self.came), len(self.answers)
        for _ in range(times):
            self.other.send(b"in", self.network.address)
            self.network.send(b"out", self.other.address)
        self.clock.advance(seconds)
        return len(self.came) - before[0], len(self.answers) - before[1]

    def test_changes_nothing_as_made(self) -> None:
        """Without a fault all datagrams pass immediately in both directions.

        The faulty network has the address of the network that it wraps.
        """
        self.assertEqual(self.network.address.host, "127.0.0.1")
        self.assertEqual(self.exchange(0.0, 20), (20, 20))

    def test_deaf_and_mute(self) -> None:
        """A deaf node only sends, a mute node only receives, and a node that is deaf and mute is disconnected."""
        for deaf, mute, passes in ((True, False, (0, 1)), (False, True, (1, 0)), (True, True, (0, 0))):
            self.network.is_receive_blocked, self.network.is_send_blocked = deaf, mute
            self.assertEqual(self.exchange(), passes)
        self.network.is_receive_blocked = self.network.is_send_blocked = False
        self.assertEqual(self.exchange(), (1, 1))

    def test_loss(self) -> None:
        """A node with the fault loss loses the configured share of datagrams in each direction.

        The rest arrives immediately.
        """
        self.network.conditions = LinkConditions(loss=0.2)
        came, went = self.exchange(times=1000)
        self.assertTrue(750 < came < 850 and 750 < went < 850, (came, went))

    def test_duplicates_and_jitter(self) -> None:
        """Duplicated datagrams arrive twice, jitter stays within its bounds, and reordered datagrams arrive last."""
        self.network.conditions = LinkConditions(delay_s=0.1, jitter_s=0.05, duplicate=1.0, reorder=1.0)
        self.assertEqual(self.exchange(0.14), (0, 0))
        self.assertEqual(self.exchange(0.12)[0], 2)

    def test_delay(self) -> None:
        """A delayed datagram arrives after the delay; a datagram that is in transit when the port closes is lost."""
        self.network.conditions = LinkConditions(delay_s=0.3)
        self.assertEqual(self.exchange(0.29), (0, 0))
        self.clock.advance(0.02)
        self.assertEqual((len(self.came), len(self.answers)), (1, 1))
        self.exchange(0.1)
        self.network.conditions = PERFECT
        self.network.close()
        self.clock.advance(1.0)
        self.assertEqual((len(self.came), len(self.answers)), (1, 1))

    def test_cut_catches_what_is_on_its_way(self) -> None:
        """If a node is disconnected, datagrams in transit are neither received nor sent."""
        self.network.conditions = LinkConditions(delay_s=0.3)
        self.exchange(0.1)
        self.network.is_receive_blocked = self.network.is_send_blocked = True
        self.clock.advance(1.0)
        self.assertEqual((self.came, self.answers), ([], []))
