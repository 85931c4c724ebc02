"""Tests of how long an answer is waited for, and how often it is asked for where datagrams get lost."""

from __future__ import annotations

import random

from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.network.switchboard import Weather
from middleware.entangled.wire.congestion import (
    BACK_OFF,
    FIRST_GUESS,
    LONGEST,
    MOST_AT_ONCE,
    MOST_TRIES,
    RARE,
    Loss,
    RoundTrip,
)
from middleware.entangled.wire.peer import MAX_TRIES
from middleware.entangled.wire.session import INIT
from tests.middleware.test_endpoint import DELAY, EndpointCase

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


def heard(share: float, count: int, rng: random.Random) -> Loss:
    """What is learned of ``count`` datagrams, of which a share gets lost."""
    loss, ahead = Loss(), 1
    for _ in range(count):
        if rng.random() < share:
            ahead += 1
        else:
            loss.arrived(ahead)
            ahead = 1
    return loss


class LossTests(SynchronousTestCase):
    """Behaviour of ``Loss``."""

    def test_the_share_is_what_gets_lost(self) -> None:
        """After some hundred datagrams the share is about right, on average over many that listen."""
        for share in (0.0, 0.1, 0.3):
            shares = [heard(share, 500, random.Random(seed)).share for seed in range(100)]
            self.assertLess(abs(sum(shares) / 100 - share), 0.02)

    def test_as_many_tries_as_it_takes(self) -> None:
        """Of an exchange whose every try fails with the share there and back, hardly any fails in all of them."""
        for share in (0.02, 0.1, 0.2):
            loss = Loss()
            loss.share = share
            fails = 1 - (1 - share) ** 2
            self.assertLessEqual(fails**loss.tries, RARE)
            self.assertGreater(fails ** (loss.tries - 1), RARE)

    def test_none_where_nothing_is_lost_and_bounded_where_all_is(self) -> None:
        """Without losses one try is enough; with nearly all lost there is a most."""
        loss = Loss()
        self.assertEqual(loss.tries, 1)
        loss.share = 0.95
        self.assertEqual(loss.tries, MOST_TRIES)

    def test_what_was_overtaken_is_not_lost(self) -> None:
        """Datagrams that come in another order than they were sent leave no more than a trace."""
        loss = Loss()
        for _ in range(100):
            loss.arrived(2)
            loss.arrived(-1)
        self.assertLess(loss.share, 0.06)

    def test_a_leap_counts_once(self) -> None:
        """A session that was cut off for long tells no more of the weather than a few datagrams do."""
        one, other = Loss(), Loss()
        one.arrived(2**40)
        other.arrived(MOST_AT_ONCE + 1)
        self.assertEqual(one.share, other.share)
        self.assertLess(one.share, 0.25)


class RoughWeatherTests(EndpointCase):
    """How questions fare where much gets lost."""

    def answered(self, count: int, timeout: float) -> int:
        """How many of so many questions, one after the other, are answered in time."""
        answers = 0
        for number in range(count):
            asked = self.a.ask(self.to_b, "echo", number, timeout=timeout)
            self.clock.advance(timeout)
            asked.addErrback(lambda failure: None)
            answers += self.successResultOf(asked) == number
        return answers

    def test_at_30_percent_lost_hardly_any_question_fails(self) -> None:
        """A question has as many tries within its time as the losses demand, where the usual four would not do."""
        self.board.weather = Weather(DELAY, loss=0.3)
        self.answered(100, 1.0)
        self.assertGreater(self.a.peers.tries, MAX_TRIES)
        self.assertGreaterEqual(self.answered(500, 1.0), 498)  # with four tries each about 466

    def test_the_first_contact_as_well(self) -> None:
        """Handshakes, too, are tried as often as the losses demand."""
        strangers = [self.endpoint(seed) for seed in range(3, 103)]
        for stranger, _ in strangers:
            self.equip(stranger)
        self.board.weather = Weather(DELAY, loss=0.3)
        self.answered(100, 1.0)
        asked = [self.a.ask(to, "echo", 1) for _, to in strangers]
        self.clock.advance(3.0)
        answers = [one.addErrback(lambda failure: None) for one in asked]
        self.assertGreaterEqual(sum(self.successResultOf(one) == 1 for one in answers), 97)  # with four tries each 94

    def test_few_tries_are_in_vain(self) -> None:
        """Where round trips differ, no more than one answer in eight is overtaken by the next try."""
        dice, path = random.Random(1), RoundTrip()
        took = [0.04 + dice.expovariate(100.0) + dice.expovariate(100.0) for _ in range(400)]
        self.a.peers.loss.share = 0.5
        late = 0
        for seconds in took:
            late += path.is_measured and seconds > self.a.peers.spacing(path, 1, 0.4)
            path.measured(seconds)
        self.assertTrue(0 < late < 50, late)
