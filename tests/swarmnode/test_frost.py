"""Tests of ``swarmnode.frost``: a node that stands still, and goes on with everything that is overdue."""

from __future__ import annotations

import random

from twisted.internet.error import AlreadyCalled, AlreadyCancelled
from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.clock import HeapClock
from middleware.entangled.network.network import Address
from middleware.entangled.network.switchboard import Switchboard
from swarmnode.frost import Frost
from swarmnode.rehearsal import VirtualTeam


class FrostTests(SynchronousTestCase):
    def setUp(self) -> None:
        """A clock, and a frost over it."""
        self.clock = HeapClock()
        self.frost = Frost(self.clock)
        self.seen: list[tuple[str, float]] = []

    def note(self, what: str) -> None:
        """Write down what happened, and when."""
        self.seen.append((what, self.clock.seconds()))

    def test_timers_wait_for_the_thaw(self) -> None:
        """What was due in the frost runs at the thaw, in order; what is due later runs at its time."""
        for delay in (3.0, 1.0, 2.0):
            self.frost.callLater(delay, self.note, f"{delay:g}")
        self.frost.freeze()
        self.clock.advance(2.5)
        self.assertEqual(self.seen, [])
        self.frost.thaw()
        self.clock.advance(1.0)
        self.assertEqual(self.seen, [("1", 2.5), ("2", 2.5), ("3", 3.0)])

    def test_overdue_timer_can_still_be_cancelled(self) -> None:
        """A timer that is overdue counts as waiting: the one that runs before it may cancel it."""
        first = self.frost.callLater(1.0, lambda: second.cancel())
        second = self.frost.callLater(1.0, self.note, "second")
        self.frost.freeze()
        self.clock.advance(5.0)
        self.assertTrue(second.active())
        self.frost.thaw()
        self.assertEqual(self.seen, [])
        self.assertRaises(AlreadyCancelled, second.cancel)
        self.assertRaises(AlreadyCalled, first.cancel)

    def test_timers_move(self) -> None:
        """A call that is put off runs at its new time only."""
        call = self.frost.callLater(1.0, self.note, "late")
        call.delay(1.0)
        self.assertEqual(call.getTime(), 2.0)
        call.reset(4.0)
        self.clock.advance(3.9)
        self.assertEqual(self.seen, [])
        self.clock.advance(0.1)
        self.assertEqual(self.seen, [("late", 4.0)])

    def test_datagrams_wait_for_the_thaw_behind_the_timers(self) -> None:
        """What arrives in the frost is heard at the thaw, after the timers."""
        board = Switchboard(self.clock, random.Random(1))
        here, there = Address("127.0.0.1", 1), Address("127.0.0.1", 2)
        network = self.frost.network(board.network(*here))
        network.listen(lambda datagram, source: self.note(datagram.decode()))
        sender = board.network(*there)
        sender.listen(lambda datagram, source: None)
        self.frost.freeze()
        sender.send(b"datagram", here)
        self.frost.callLater(1.0, self.note, "timer")
        self.clock.advance(2.0)
        self.frost.thaw()
        self.assertEqual(self.seen, [("timer", 2.0), ("datagram", 2.0)])
        self.assertEqual(network.address, here)


class FrozenNodeTests(SynchronousTestCase):
    def test_frozen_node_is_missed_and_comes_back(self) -> None:
        """A dog whose node stands still is gone from the page within its presence lease, and back after the thaw."""
        team = VirtualTeam(3, camera_fps=0.1)

        def here() -> list[str]:
            return [device["name"] for device in team.state()["devices"] if device["gone"] is None]

        self.assertEqual(here(), ["vaio", "dog1", "dog2", "dog3"])
        team.freeze("dog2")
        team.clock.advance(4.0)
        self.assertEqual(here(), ["vaio", "dog1", "dog3"])
        team.thaw("dog2")
        team.clock.advance(4.0)
        self.assertEqual(here(), ["vaio", "dog1", "dog2", "dog3"])
        team.stop()
