"""Tests of the limit on requests in flight, and of the queue of further requests."""

from __future__ import annotations

from typing import Any

from twisted.internet.defer import CancelledError, Deferred

from middleware.entangled.contact import Contact
from middleware.entangled.errors import Crowded, NoAnswer
from middleware.entangled.network.switchboard import LinkConditions
from middleware.entangled.wire import requester
from middleware.entangled.wire.congestion import INITIAL_TIMEOUT_S
from middleware.entangled.wire.peer import MIN_CHECK_TRIES
from middleware.entangled.wire.requester import MAX_IN_FLIGHT
from middleware.entangled.wire.session import INIT
from tests.middleware.test_endpoint import DELAY, EndpointCase

SLOW_S = 0.2


class TurnTests(EndpointCase):
    """Tests of ``Requester`` with more requests than may be in flight."""

    def setUp(self) -> None:
        """Open a session."""
        super().setUp()
        self.got(self.a.ask(self.to_b, "echo", 1))

    def equip(self, endpoint: Any) -> None:
        """Register a slow method."""
        super().equip(endpoint)
        endpoint.expose("slow", self.slow)

    def slow(self, peer: Contact, value: int) -> Deferred[int]:
        """Reply after a delay."""
        self.runs.append(value)
        answer: Deferred[int] = Deferred()
        self.clock.callLater(SLOW_S, answer.callback, value)
        return answer

    def flood(self, count: int, timeout: float | None = None) -> list[Deferred[Any]]:
        """Send many requests at the same time."""
        return [self.a.ask(self.to_b, "slow", number, timeout=timeout) for number in range(count)]

    def test_the_rest_waits_in_order(self) -> None:
        """At most ``MAX_IN_FLIGHT`` requests are sent at once; the others follow in order when replies arrive."""
        sent = self.switchboard.counters["sent"]
        asked = self.flood(12 * MAX_IN_FLIGHT)
        self.assertEqual(self.switchboard.counters["sent"] - sent, MAX_IN_FLIGHT)
        self.clock.advance(DELAY)
        self.assertEqual(self.runs, list(range(MAX_IN_FLIGHT)))
        self.clock.advance(2.0)
        self.assertTrue(any(not one.called for one in asked))
        self.clock.advance(2.0)
        self.assertEqual([self.successResultOf(one) for one in asked], list(range(12 * MAX_IN_FLIGHT)))
        self.assertEqual(list(dict.fromkeys(self.runs)), list(range(12 * MAX_IN_FLIGHT)))
        self.assertEqual(self.places(), (0, 0, 0))

    def test_a_dead_peer(self) -> None:
        """If a peer has failed, sent requests fail with ``NoAnswer`` and queued requests with ``Crowded``.

        No state remains.
        """
        self.switchboard.kill(self.to_b.address)
        asked = self.flood(20 * MAX_IN_FLIGHT)
        self.clock.advance(30.0)
        kinds = [self.failureResultOf(one, NoAnswer, Crowded).type for one in asked]
        self.assertEqual(kinds[0], NoAnswer)
        self.assertEqual(kinds[-1], Crowded)
        self.assertEqual(self.places(), (0, 0, 0))

    def test_a_time_out_holds_in_the_queue(self) -> None:
        """A timeout also applies to a queued request."""
        asked = self.flood(20 * MAX_IN_FLIGHT, timeout=0.5)
        self.clock.advance(0.5)
        self.assertTrue(all(one.called for one in asked))
        for one in asked:
            one.addErrback(lambda failure: failure.trap(NoAnswer, Crowded))

    def test_cancelled_in_the_queue(self) -> None:
        """A queued request that is cancelled is never sent; cancelling a sent request lets the next request be sent."""
        asked = self.flood(MAX_IN_FLIGHT + 2)
        asked[-1].cancel()
        asked[0].cancel()
        for one in (asked[0], asked[-1]):
            self.failureResultOf(one, CancelledError)
        self.clock.advance(DELAY)
        self.assertEqual(self.runs, list(range(MAX_IN_FLIGHT + 1)))
        self.clock.advance(1)
        self.assertEqual(self.places(), (0, 0, 0))

    def test_long_questions_take_no_place(self) -> None:
        """Requests with a long timeout do not block requests with a short timeout."""
        for one in self.flood(2 * MAX_IN_FLIGHT, timeout=60.0):
            one.addErrback(lambda failure: None)
        self.assertEqual(self.got(self.a.ask(self.to_b, "echo", 7), 2 * DELAY), 7)

    def test_the_queue_is_bounded(self) -> None:
        """If the queue is full, a further request fails immediately."""
        self.patch(requester, "MAX_QUEUED", 3)
        asked = self.flood(MAX_IN_FLIGHT + 5)
        for one in asked[-2:]:
            self.failureResultOf(one, Crowded)
        self.clock.advance(1)
        for one in asked[:-2]:
            self.successResultOf(one)

    def test_before_the_session(self) -> None:
        """Requests that wait for a handshake keep their order and the limit."""
        third, to_third = self.endpoint(3)
        self.equip(third)
        sent = self.switchboard.counters["sent"]
        asked = [self.a.ask(to_third, "add", number, changes=True) for number in range(2 * MAX_IN_FLIGHT)]
        self.clock.advance(2 * DELAY)
        self.assertEqual(self.switchboard.counters["sent"] - sent, 2 + MAX_IN_FLIGHT)
        self.clock.advance(1)
        self.assertEqual([self.successResultOf(one) for one in asked], self.runs)

    def test_restart_in_the_middle(self) -> None:
        """A peer that restarts during many requests answers all of them."""
        asked = self.flood(4 * MAX_IN_FLIGHT)
        self.clock.advance(0.05)
        self.switchboard.kill(self.to_b.address)
        self.b, _ = self.endpoint(9, port=self.to_b.address.port, identity=2)
        self.equip(self.b)
        self.clock.advance(10)
        self.assertEqual([self.successResultOf(one) for one in asked], list(range(4 * MAX_IN_FLIGHT)))

    def places(self) -> tuple[int, int, int]:
        """Return three numbers: requests in flight, in the peer's queue and in all queues."""
        at = self.a._peers.get(self.to_b.public)
        assert at is not None
        return at.in_flight, len(at.queue), self.a._requester._queued


class GivenUpTests(EndpointCase):
    """Tests of handshakes that last longer than the requests that started them."""

    def inits(self) -> int:
        """Return the number of INITs that arrived at ``b``, including retransmissions."""
        return sum(datagram[0] == INIT for datagram, _ in self.taps[self.to_b.address].kept)

    def give_up(self, timeout: float) -> None:
        """Send a request, and wait until it times out."""
        self.failed(self.a.ask(self.to_b, "echo", 1, timeout=timeout), NoAnswer, timeout)

    def test_nothing_more_is_sent_for_nobody(self) -> None:
        """After all its requests have ended, a handshake is not retransmitted, and is soon removed."""
        self.switchboard.kill(self.to_b.address)
        sent = self.switchboard.counters["sent"]
        self.give_up(INITIAL_TIMEOUT_S / 2)
        self.clock.advance(5.0)
        self.assertEqual(self.switchboard.counters["sent"] - sent, 1)
        self.assertEqual(self.a.peers.get_or_create(self.to_b).handshake, None)

    def test_a_late_answer_opens_the_session(self) -> None:
        """A late reply to a handshake still opens the session for the next request."""
        self.switchboard.conditions = LinkConditions(0.3)
        self.give_up(0.2)
        self.clock.advance(1.0)
        self.assertTrue(self.a.has_session(self.to_b))

    def test_who_asks_meanwhile_need_not_wait(self) -> None:
        """A new request during a paused handshake retransmits the handshake immediately."""
        self.switchboard.conditions = LinkConditions(DELAY, loss=1.0)
        self.give_up(INITIAL_TIMEOUT_S / 2)
        self.clock.advance(INITIAL_TIMEOUT_S)
        self.switchboard.conditions = LinkConditions(DELAY)
        self.assertEqual(self.got(self.a.ask(self.to_b, "echo", 2), 5 * DELAY), 2)
        self.assertEqual(self.inits(), 1)

    def test_two_handshakes_in_doubt(self) -> None:
        """A silent peer with a session gets at most ``MIN_CHECK_TRIES`` INITs, for any number of requests."""
        self.assertEqual(self.got(self.a.ask(self.to_b, "echo", 1), 5 * DELAY), 1)
        self.switchboard.conditions = LinkConditions(DELAY, loss=1.0)
        sent: list[int] = []
        self.patch(self.a._network, "send", lambda datagram, to: sent.append(datagram[0]))
        asked = [self.a.ask(self.to_b, "echo", number) for number in range(3)]
        for _ in range(30):
            self.clock.advance(0.1)
        self.assertEqual(sent.count(INIT), MIN_CHECK_TRIES)
        for one in asked:
            self.failureResultOf(one, NoAnswer)
