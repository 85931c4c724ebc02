"""Tests of ``webnode.sign_in_delay``: repeated attempts delay only their own source."""

from __future__ import annotations

from twisted.trial.unittest import SynchronousTestCase

from webnode.sign_in_delay import FORGET_S, LONGEST_S, MAX_SOURCES, SignInDelays


class SignInDelaysTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.delays = SignInDelays()

    def guesses(self, source: str, seconds: float) -> int:
        """Return the number of attempts that a source can make in the given time."""
        now, count = 0.0, 0
        while now < seconds:
            wait = self.delays.get_wait(source, now)
            if wait == 0.0:
                self.delays.count_attempt(source, now)
                count += 1
            now += wait
        return count

    def test_allow_few_guesses(self) -> None:
        """A source has at most 20 attempts in the first hour, and later about one per hour."""
        self.assertEqual(self.guesses("192.168.0.9", 3600.0), 19)
        self.setUp()
        self.assertLessEqual(self.guesses("192.168.0.9", 86400.0), 20 + 24)

    def test_lock_out_nobody_else(self) -> None:
        """Attempts from one address do not delay a different address."""
        self.guesses("192.168.0.9", 3600.0)
        self.assertGreater(self.delays.get_wait("192.168.0.9", 3600.0), 0.0)
        self.assertEqual(self.delays.get_wait("192.168.0.10", 3600.0), 0.0)

    def test_count_a_network_of_addresses_as_one(self) -> None:
        """Addresses of the same IPv6 network share one delay.

        Each IPv4 address has its own delay, in either notation.
        """
        for number in range(10):
            self.delays.count_attempt(f"2001:db8::{number:x}", 0.0)
            self.delays.count_attempt(f"::ffff:10.0.0.{number}", 0.0)
        self.assertGreater(self.delays.get_wait("2001:db8::ffff", 0.0), 0.0)
        self.assertEqual(self.delays.get_wait("2001:db8:0:1::1", 0.0), 0.0)
        self.assertEqual(self.delays.get_wait("10.0.0.3", 0.0), 0.0)

    def test_forget(self) -> None:
        """A successful sign-in, or a day without attempts, resets the delay."""
        self.guesses("a", 3600.0)
        self.delays.forget("a")
        self.assertEqual(self.guesses("a", 1.0), 10)
        self.assertEqual(self.delays.get_wait("a", FORGET_S + 1.0), 0.0)

    def test_remember_a_bounded_number(self) -> None:
        """The number of remembered sources is limited, and the most recent source is always remembered."""
        for number in range(MAX_SOURCES + 10):
            for _ in range(10):
                self.delays.count_attempt(f"10.{number >> 16}.{number >> 8 & 255}.{number & 255}", 0.0)
        self.assertEqual(len(self.delays._attempts), MAX_SOURCES)
        self.assertGreater(self.delays.get_wait(f"10.0.{MAX_SOURCES >> 8}.9", 0.0), 0.0)

    def test_survive_a_clock_that_is_set_back(self) -> None:
        """When the clock is set back, the delay of a source does not exceed the maximum."""
        self.guesses("a", 10**6)
        self.assertLessEqual(self.delays.get_wait("a", 0.0), LONGEST_S)

    def test_take_a_try_back(self) -> None:
        """``uncount_attempt`` removes a successful attempt from the count, so only wrong attempts count.

        The limits are configurable.
        """
        delays = SignInDelays(free=3, longest_s=10.0, forgotten_s=100.0)
        for _ in range(20):
            delays.count_attempt("everywhere", 0.0)
            delays.uncount_attempt("everywhere")
        self.assertEqual(delays.get_wait("everywhere", 0.0), 0.0)
        for _ in range(8):
            delays.count_attempt("everywhere", 0.0)
        delays.uncount_attempt("everywhere")
        self.assertEqual((delays.get_wait("everywhere", 0.0), delays.get_wait("everywhere", 100.0)), (10.0, 0.0))
        delays.uncount_attempt("nobody")
