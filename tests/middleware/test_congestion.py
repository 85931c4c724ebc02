"""Tests of the round-trip estimate, the loss estimate and the number of retransmissions."""

from __future__ import annotations

import random

from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.network.switchboard import LinkConditions
from middleware.entangled.wire.congestion import (
    BACKOFF_FACTOR,
    INITIAL_TIMEOUT_S,
    MAX_GAP_LOSSES,
    MAX_TIMEOUT_S,
    MAX_TRIES_AT_LOSS,
    TOLERATED_FAILURES,
    LossRate,
    RoundTrip,
)
from middleware.entangled.wire.peer import MAX_TRIES
from middleware.entangled.wire.session import INIT
from tests.middleware.test_endpoint import DELAY, EndpointCase

FAR = 0.12
"""The delay in one direction in seconds; a round trip takes longer than the initial timeout of the first try."""


class RoundTripTests(SynchronousTestCase):
    """Tests of ``RoundTrip``."""

    def test_an_answer_to_the_second_try(self) -> None:
        """A reply after a retransmission is ambiguous, so it is not measured; the timeout grows within limits."""
        for seconds, wait in ((0.0, INITIAL_TIMEOUT_S * BACKOFF_FACTOR), (0.4, 0.4), (60.0, MAX_TIMEOUT_S)):
            unknown = RoundTrip()
            unknown.lengthen(seconds)
            self.assertEqual((unknown.timeout, unknown.is_measured), (wait, False))
        known = RoundTrip()
        known.add_sample(0.02)
        wait = known.timeout
        known.lengthen(0.4)
        self.assertEqual(known.timeout, wait * BACKOFF_FACTOR)


class LongWayTests(EndpointCase):
    """Tests of a first contact over a path with a longer delay than the initial estimate."""

    def setUp(self) -> None:
        """Set a long delay between the two endpoints."""
        super().setUp()
        self.equip(self.a)
        self.switchboard.conditions = LinkConditions(FAR)

    def test_one_handshake_is_enough(self) -> None:
        """Concurrent requests in both directions wait for the same handshake, and start no second one."""
        self.got(self.a.ask(self.to_b, "add", 1))
        self.got(self.b.ask(self.to_a, "add", 2))
        self.got(self.a.ask(self.to_b, "add", 3))
        inits = {datagram for tap in self.taps.values() for datagram, _ in tap.kept if datagram[0] == INIT}
        self.assertEqual((len(inits), self.runs), (1, [1, 2, 3]))

    def test_who_was_asked_knows_the_way(self) -> None:
        """The confirmation of a session gives the responder a round-trip time; its next request is sent only once."""
        self.got(self.a.ask(self.to_b, "echo", 1))
        self.assertEqual(self.b.round_trip(self.to_a), 2 * FAR)
        sent = self.switchboard.counters["sent"]
        self.got(self.b.ask(self.to_a, "echo", 2))
        self.assertEqual(self.switchboard.counters["sent"] - sent, 2)


def heard(share: float, count: int, rng: random.Random) -> LossRate:
    """Simulate ``count`` datagrams with this loss rate, and return the estimate."""
    loss, ahead = LossRate(), 1
    for _ in range(count):
        if rng.random() < share:
            ahead += 1
        else:
            loss.record_arrival(ahead)
            ahead = 1
    return loss


class LossTests(SynchronousTestCase):
    """Tests of ``LossRate``."""

    def test_the_share_is_what_gets_lost(self) -> None:
        """After 500 datagrams the estimates of 100 receivers have a mean within 0.02 of the loss rate."""
        for share in (0.0, 0.1, 0.3):
            shares = [heard(share, 500, random.Random(seed)).rate for seed in range(100)]
            self.assertLess(abs(sum(shares) / 100 - share), 0.02)

    def test_as_many_tries_as_it_takes(self) -> None:
        """The number of tries keeps the probability that all of them fail below ``TOLERATED_FAILURES``."""
        for share in (0.02, 0.1, 0.2):
            loss = LossRate()
            loss.rate = share
            fails = 1 - (1 - share) ** 2
            self.assertLessEqual(fails**loss.tries, TOLERATED_FAILURES)
            self.assertGreater(fails ** (loss.tries - 1), TOLERATED_FAILURES)

    def test_none_where_nothing_is_lost_and_bounded_where_all_is(self) -> None:
        """Without loss one try is enough; with high loss the number of tries is limited."""
        loss = LossRate()
        self.assertEqual(loss.tries, 1)
        loss.rate = 0.95
        self.assertEqual(loss.tries, MAX_TRIES_AT_LOSS)

    def test_what_was_overtaken_is_not_lost(self) -> None:
        """Reordered datagrams raise the loss estimate only slightly."""
        loss = LossRate()
        for _ in range(100):
            loss.record_arrival(2)
            loss.record_arrival(-1)
        self.assertLess(loss.rate, 0.06)

    def test_a_leap_counts_once(self) -> None:
        """A long gap in the sequence numbers counts as at most ``MAX_GAP_LOSSES`` lost datagrams."""
        one, other = LossRate(), LossRate()
        one.record_arrival(2**40)
        other.record_arrival(MAX_GAP_LOSSES + 1)
        self.assertEqual(one.rate, other.rate)
        self.assertLess(one.rate, 0.25)


class RoughWeatherTests(EndpointCase):
    """Tests of requests under high loss."""

    def answered(self, count: int, timeout: float) -> int:
        """Return the number of ``count`` sequential requests that are answered in time."""
        answers = 0
        for number in range(count):
            asked = self.a.ask(self.to_b, "echo", number, timeout=timeout)
            self.clock.advance(timeout)
            asked.addErrback(lambda failure: None)
            answers += self.successResultOf(asked) == number
        return answers

    def test_at_30_percent_lost_hardly_any_question_fails(self) -> None:
        """At 30 % loss a request gets more tries within its timeout than the usual four, and rarely fails."""
        self.switchboard.conditions = LinkConditions(DELAY, loss=0.3)
        self.answered(100, 1.0)
        self.assertGreater(self.a.peers.tries, MAX_TRIES)
        self.assertGreaterEqual(self.answered(500, 1.0), 498)  # with four tries about 466 requests would be answered

    def test_the_first_contact_as_well(self) -> None:
        """Handshakes are also retransmitted according to the loss rate."""
        strangers = [self.endpoint(seed) for seed in range(3, 103)]
        for stranger, _ in strangers:
            self.equip(stranger)
        self.switchboard.conditions = LinkConditions(DELAY, loss=0.3)
        self.answered(100, 1.0)
        asked = [self.a.ask(to, "echo", 1) for _, to in strangers]
        self.clock.advance(3.0)
        answers = [one.addErrback(lambda failure: None) for one in asked]
        # With only four tries 94 handshakes would succeed.
        self.assertGreaterEqual(sum(self.successResultOf(one) == 1 for one in answers), 97)

    def test_few_tries_are_in_vain(self) -> None:
        """With variable round-trip times at most one reply in eight arrives after an unnecessary retransmission."""
        dice, path = random.Random(1), RoundTrip()
        took = [0.04 + dice.expovariate(100.0) + dice.expovariate(100.0) for _ in range(400)]
        self.a.peers.loss.rate = 0.5
        late = 0
        for seconds in took:
            late += path.is_measured and seconds > self.a.peers.retry_interval(path, 1, 0.4)
            path.add_sample(seconds)
        self.assertTrue(0 < late < 50, late)
