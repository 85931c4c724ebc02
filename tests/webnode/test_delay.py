"""Tests of ``webnode.delay``: whoever guesses waits, and nobody else."""

from __future__ import annotations

from twisted.trial.unittest import SynchronousTestCase

from webnode.delay import FORGOTTEN_S, LONGEST_S, SOURCES, Delays


class DelaysTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.delays = Delays()

    def guesses(self, source: str, seconds: float) -> int:
        """How often somebody who tries as soon as it may can try in so many seconds."""
        now, count = 0.0, 0
        while now < seconds:
            wait = self.delays.wait(source, now)
            if wait == 0.0:
                self.delays.tried(source, now)
                count += 1
            now += wait
        return count

    def test_allow_few_guesses(self) -> None:
        """At most 20 guesses come through in an hour, and about one an hour after that."""
        self.assertEqual(self.guesses("192.168.0.9", 3600.0), 19)
        self.setUp()
        self.assertLessEqual(self.guesses("192.168.0.9", 86400.0), 20 + 24)

    def test_lock_out_nobody_else(self) -> None:
        """Another address may try at once, however much the one has guessed."""
        self.guesses("192.168.0.9", 3600.0)
        self.assertGreater(self.delays.wait("192.168.0.9", 3600.0), 0.0)
        self.assertEqual(self.delays.wait("192.168.0.10", 3600.0), 0.0)

    def test_count_a_network_of_addresses_as_one(self) -> None:
        """Whoever has a network of IPv6 addresses guesses no more often; IPv4 counts alone, however it is written."""
        for number in range(10):
            self.delays.tried(f"2001:db8::{number:x}", 0.0)
            self.delays.tried(f"::ffff:10.0.0.{number}", 0.0)
        self.assertGreater(self.delays.wait("2001:db8::ffff", 0.0), 0.0)
        self.assertEqual(self.delays.wait("2001:db8:0:1::1", 0.0), 0.0)
        self.assertEqual(self.delays.wait("10.0.0.3", 0.0), 0.0)

    def test_forget(self) -> None:
        """A right one forgets those before, and so does a day without any."""
        self.guesses("a", 3600.0)
        self.delays.held("a")
        self.assertEqual(self.guesses("a", 1.0), 10)
        self.assertEqual(self.delays.wait("a", FORGOTTEN_S + 1.0), 0.0)

    def test_remember_a_bounded_number(self) -> None:
        """However many addresses guess, no more than so many are remembered; who guessed last is one of them."""
        for number in range(SOURCES + 10):
            for _ in range(10):
                self.delays.tried(f"10.{number >> 16}.{number >> 8 & 255}.{number & 255}", 0.0)
        self.assertEqual(len(self.delays._tries), SOURCES)
        self.assertGreater(self.delays.wait(f"10.0.{SOURCES >> 8}.9", 0.0), 0.0)

    def test_survive_a_clock_that_is_set_back(self) -> None:
        """Nobody waits longer than the longest pause because the clock was set back."""
        self.guesses("a", 10**6)
        self.assertLessEqual(self.delays.wait("a", 0.0), LONGEST_S)

    def test_take_a_try_back(self) -> None:
        """Of tries that were right nothing is left, and those that were wrong count; with other numbers, too."""
        delays = Delays(free=3, longest_s=10.0, forgotten_s=100.0)
        for _ in range(20):
            delays.tried("everywhere", 0.0)
            delays.undo("everywhere")
        self.assertEqual(delays.wait("everywhere", 0.0), 0.0)
        for _ in range(8):
            delays.tried("everywhere", 0.0)
        delays.undo("everywhere")
        self.assertEqual((delays.wait("everywhere", 0.0), delays.wait("everywhere", 100.0)), (10.0, 0.0))
        delays.undo("nobody")
