"""Tests of a node's simulated computer."""

from __future__ import annotations

import random

from twisted.internet.error import AlreadyCalled, AlreadyCancelled
from twisted.internet.interfaces import IReactorTime
from twisted.trial.unittest import SynchronousTestCase
from zope.interface.verify import verifyObject

from middleware.entangled.clock import HeapClock
from middleware.entangled.network.switchboard import Switchboard
from sim.team.machine import MAX_QUEUED_DATAGRAMS, Machine, MachineNetwork


class MachineTests(SynchronousTestCase):
    """Tests of ``Machine`` and ``MachineNetwork``."""

    def setUp(self) -> None:
        """Create a clock, and a list of results."""
        self.world = HeapClock()
        self.seen: list[object] = []

    def test_clock_runs_at_its_own_rate(self) -> None:
        """The timers of a fast clock fire early; a new rate does not change the time that has already passed."""
        machine = Machine(self.world, 2.0, 100.0)
        verifyObject(IReactorTime, machine)
        machine.callLater(4.0, lambda: self.seen.append(self.world.seconds()))
        self.world.advance(3.0)
        self.assertEqual((self.seen, machine.seconds()), ([2.0], 106.0))
        machine.set_rate(0.5)
        self.world.advance(2.0)
        self.assertEqual(machine.seconds(), 107.0)

    def test_waiting_for_what_is_left_ends(self) -> None:
        """A timer that is repeatedly set for the remaining time reaches its deadline despite rounding."""
        rng = random.Random(1)
        for _ in range(300):
            self.world = HeapClock(1e6 + rng.random())  # floats are coarser here than near 0
            rate = rng.uniform(0.99, 1.01)
            machine = Machine(self.world, rate, -rate * self.world.seconds())
            turns: list[int] = []
            deadline = machine.seconds() + 0.3 * rng.random()

            def again(machine: Machine = machine, deadline: float = deadline, turns: list[int] = turns) -> None:
                turns.append(1)
                if machine.seconds() < deadline and len(turns) < 50:
                    machine.callLater(deadline - machine.seconds(), again)

            again()
            self.world.advance(1.0)
            self.assertLess(len(turns), 5, f"rate {rate}")

    def test_what_was_due_waits_for_the_thaw(self) -> None:
        """A frozen machine runs nothing; after the thaw the overdue timers run in order, and then datagrams arrive."""
        board = Switchboard(self.world, random.Random(1))
        machine = Machine(self.world)
        network = MachineNetwork(machine, board.make_network("10.0.0.1", 7000))
        network.listen(lambda datagram, source: self.seen.append(datagram))
        other = board.make_network("10.0.0.2", 7000)
        other.listen(lambda datagram, source: None)
        machine.freeze()
        machine.callLater(2.0, self.seen.append, "second")
        machine.callLater(1.0, self.seen.append, "first")
        machine.callLater(1.5, self.seen.append, "never").cancel()
        other.send(b"hello", network.address)
        self.world.advance(3.0)
        self.assertEqual((self.seen, machine.seconds()), ([], 3.0))
        machine.thaw()
        self.assertEqual(self.seen, ["first", "second", b"hello"])

    def test_overdue_timer_can_be_cancelled(self) -> None:
        """An overdue timer stays active until it runs, so an overdue timer that runs first can cancel it."""
        machine = Machine(self.world)
        first = machine.callLater(1.0, lambda: second.cancel())
        second = machine.callLater(1.0, self.seen.append, "second")
        machine.freeze()
        self.world.advance(5.0)
        self.assertTrue(second.active())
        machine.thaw()
        self.assertEqual(self.seen, [])
        self.assertRaises(AlreadyCancelled, second.cancel)
        self.assertRaises(AlreadyCalled, first.cancel)

    def test_clock_that_stops_while_suspended(self) -> None:
        """A clock normally counts the time of a suspension; if ``COUNTS_SUSPENSION`` is false, it lags by that time."""
        for counts, shown in ((True, 8.0), (False, 2.0)):
            self.world = HeapClock()
            machine = Machine(self.world, 2.0)
            machine.COUNTS_SUSPENSION = counts
            self.world.advance(1.0)
            machine.freeze(is_suspended=True)
            self.world.advance(3.0)
            self.assertEqual(machine.seconds(), shown)
            machine.thaw()
            self.assertEqual((machine.seconds(), machine.to_simulator_time(shown + 2.0)), (shown, 5.0))
            self.assertEqual(machine.to_unsuspended_time(shown), shown / 2.0)

    def test_buffer_holds_so_many_datagrams(self) -> None:
        """A frozen machine buffers the first ``MAX_QUEUED_DATAGRAMS`` datagrams and drops all later ones."""
        machine = Machine(self.world)
        machine.freeze()
        for number in range(MAX_QUEUED_DATAGRAMS + 50):
            machine.deliver_datagram(lambda datagram, source: self.seen.append(datagram), b"%d" % number, None)
        machine.thaw()
        self.assertEqual((len(self.seen), self.seen[0]), (MAX_QUEUED_DATAGRAMS, b"0"))

    def test_dead_machine_does_nothing(self) -> None:
        """Timers of a dead machine never run, even if the machine was frozen when it died."""
        machine = Machine(self.world)
        machine.callLater(1.0, self.seen.append, "late")
        machine.freeze()
        self.world.advance(2.0)
        machine.callLater(1.0, self.seen.append, "later")
        machine.die()
        machine.thaw()
        self.world.advance(2.0)
        self.assertEqual(self.seen, [])

    def test_calls_can_be_moved_and_taken_back_once(self) -> None:
        """A call is rescheduled in seconds of the machine's clock; a finished or cancelled call cannot be changed."""
        machine = Machine(self.world, 2.0)
        call = machine.callLater(2.0, self.seen.append, "moved")
        call.reset(6.0)
        call.delay(2.0)
        self.assertEqual((call.getTime(), call.active()), (8.0, True))
        self.world.advance(3.9)
        self.assertEqual(self.seen, [])
        self.world.advance(0.2)
        self.assertEqual(self.seen, ["moved"])
        self.assertRaises(AlreadyCalled, call.cancel)
        other = machine.callLater(1.0, self.seen.append, "x")
        other.cancel()
        self.assertRaises(AlreadyCancelled, other.reset, 1.0)
