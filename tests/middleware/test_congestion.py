"""Tests of how long an answer is waited for, and of what a long way costs at first."""

from __future__ import annotations

from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.network.switchboard import Weather
from middleware.entangled.wire.congestion import BACK_OFF, FIRST_GUESS, LONGEST, RoundTrip
from middleware.entangled.wire.session import INIT
from tests.middleware.test_endpoint import EndpointCase

FAR = 0.12
"""Seconds one way: longer there and back than the first guess and its first try."""


class RoundTripTests(SynchronousTestCase):
    """Behaviour of ``RoundTrip``."""

    def test_an_answer_to_the_second_try(self) -> None:
        """It may belong to either, so nothing is measured; the wait grows, up to what the answer took or the most."""
        for seconds, wait in ((0.0, FIRST_GUESS * BACK_OFF), (0.4, 0.4), (60.0, LONGEST)):
            unknown = RoundTrip()
            unknown.ambiguous(seconds)
            self.assertEqual((unknown.wait, unknown.is_measured), (wait, False))
        known = RoundTrip()
        known.measured(0.02)
        wait = known.wait
        known.ambiguous(0.4)
        self.assertEqual(known.wait, wait * BACK_OFF)


class LongWayTests(EndpointCase):
    """A first contact over a way that is longer than anybody guesses."""

    def setUp(self) -> None:
        """Move the two apart."""
        super().setUp()
        self.equip(self.a)
        self.board.weather = Weather(FAR)

    def test_one_handshake_is_enough(self) -> None:
        """Whoever asks or asks back what waits for the session, no second handshake is begun meanwhile."""
        self.got(self.a.ask(self.to_b, "add", 1))
        self.got(self.b.ask(self.to_a, "add", 2))
        self.got(self.a.ask(self.to_b, "add", 3))
        inits = {datagram for tap in self.taps.values() for datagram, _ in tap.kept if datagram[0] == INIT}
        self.assertEqual((len(inits), self.runs), (1, [1, 2, 3]))

    def test_who_was_asked_knows_the_way(self) -> None:
        """The confirmation of a session times the way for the one that was asked, which then asks back only once."""
        self.got(self.a.ask(self.to_b, "echo", 1))
        self.assertEqual(self.b.round_trip(self.to_a), 2 * FAR)
        sent = self.board.counters["sent"]
        self.got(self.b.ask(self.to_a, "echo", 2))
        self.assertEqual(self.board.counters["sent"] - sent, 2)
