"""Tests of ``middleware.entangled.quorum.round``."""

from __future__ import annotations

import math
from typing import Any

from twisted.internet.defer import Deferred, fail, succeed
from twisted.trial.unittest import SynchronousTestCase

from middleware.consensus.lease.lease_codec import pack_reply, parse_reply
from middleware.entangled.clock import HeapClock
from middleware.entangled.errors import NoAnswer
from middleware.entangled.quorum.register import Reply, ReplyKind
from middleware.entangled.quorum.round import MIN_TRIES, NEWS_INTERVAL_S, RETRY_INTERVAL_S, Round, Tally

YES, NO = Reply(ReplyKind.GRANTED), Reply(ReplyKind.HELD, remaining=1.0)


def decoded(place: int, answer: object) -> list[Reply] | None:
    """Decode a reply as the proposer of a lease does."""
    reply = parse_reply(answer)
    return None if reply is None else [reply]


class RoundTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.clock = HeapClock()
        self.asked: list[tuple[float, int, Deferred[Any]]] = []

    def ask(self, place: int) -> Deferred[Any]:
        self.asked.append((self.clock.seconds(), place, Deferred()))
        return self.asked[-1][2]

    def round(self, size: int = 3, short: float = RETRY_INTERVAL_S) -> Round:
        return Round([Tally(size)], self.ask, decoded, self.clock, 0.5, short)

    def answer(self, number: int, reply: Reply) -> None:
        self.asked[number][2].callback(pack_reply(reply))

    def test_decided_by_a_majority(self) -> None:
        """The second grant or second rejection of three members decides the round; a round without members is lost."""
        for reply, is_won in ((YES, True), (NO, False)):
            asked = self.round()
            self.answer(-3, reply)
            self.assertNoResult(asked.outcome)
            self.answer(-1, reply)
            self.assertEqual(self.successResultOf(asked.outcome).tally.is_won, is_won)
            asked.close()
        self.assertFalse(self.successResultOf(self.round(0).outcome).tally.is_won)

    def test_members_about_to_be_free_are_asked_again(self) -> None:
        """A member whose lease ends within 100 ms gets the request again at the end; later ends count as rejections."""
        asked = self.round()
        self.answer(0, Reply(ReplyKind.HELD, remaining=0.03))
        self.answer(1, NO)
        self.assertNoResult(asked.outcome)
        self.clock.advance(0.03)
        self.assertEqual([member for _, member, _ in self.asked[3:]], [0])
        self.answer(3, YES)
        self.answer(2, YES)
        self.assertTrue(self.successResultOf(asked.outcome).tally.is_won)

    def test_news_that_a_member_has_not_heard(self) -> None:
        """After a release, members that still report a lease soon get the request again, except if ``short`` is 0."""
        asked = self.round(short=math.inf)
        self.answer(0, NO)
        self.answer(1, NO)
        self.assertNoResult(asked.outcome)
        self.clock.advance(NEWS_INTERVAL_S)
        self.assertEqual([member for _, member, _ in self.asked[3:]], [0, 1])
        self.answer(3, YES)
        self.answer(4, YES)
        self.assertTrue(self.successResultOf(asked.outcome).tally.is_won)
        self.asked.clear()
        looked = self.round(short=0.0)
        self.answer(0, Reply(ReplyKind.HELD, remaining=0.03))
        self.answer(1, Reply(ReplyKind.HELD, remaining=0.03))
        self.assertFalse(self.successResultOf(looked.outcome).tally.is_won)

    def test_who_is_silent(self) -> None:
        """A member that has sent any reply counts as present.

        A member that has not replied to three requests counts as silent.
        """
        asked = self.round()
        self.answer(1, NO)
        self.assertEqual((asked.answered_places, asked.silent_places), ([1], []))
        self.clock.advance(RETRY_INTERVAL_S * (MIN_TRIES - 1))
        self.assertEqual(asked.silent_places, [0, 2])
        self.answer(0, Reply(ReplyKind.HELD, remaining=0.05))
        self.assertEqual((asked.answered_places, asked.silent_places), ([1, 0], [2]))

    def test_silent_members_are_asked_again(self) -> None:
        """A silent member gets the request every 100 ms until the decision, and at least three times.

        A member that has replied gets it once.
        """
        self.round()
        self.answer(1, YES)
        self.answer(2, YES)
        self.clock.advance(1.0)
        moments = [round(moment, 6) for moment, member, _ in self.asked if member == 0]
        self.assertEqual(moments, [number * RETRY_INTERVAL_S for number in range(MIN_TRIES)])
        self.assertEqual([member for _, member, _ in self.asked].count(1), 1)
        del self.asked[:]
        self.round()
        self.clock.advance(0.45)
        self.assertEqual([member for _, member, _ in self.asked], [0, 1, 2] * 5)

    def test_patience(self) -> None:
        """Without replies the round ends at its timeout and leaves no timer."""
        asked = self.round()
        self.clock.advance(0.49)
        self.assertNoResult(asked.outcome)
        self.clock.advance(0.02)
        self.assertFalse(self.successResultOf(asked.outcome).tally.is_won)
        self.assertEqual(self.clock.getDelayedCalls(), [])

    def test_a_member_that_is_down_holds_nobody_up(self) -> None:
        """If a majority has replied without a decision, a silent last member delays the end only briefly."""
        asked = self.round()
        self.answer(0, YES)
        self.answer(1, NO)
        self.clock.advance(RETRY_INTERVAL_S + 0.01)
        self.assertFalse(self.successResultOf(asked.outcome).tally.is_won)

    def test_sent_at_counts_the_latest_majority(self) -> None:
        """The grants count from the time of the earliest request in the latest majority."""
        asked = self.round()
        self.answer(0, YES)
        self.clock.advance(0.25)
        self.answer(len(self.asked) - 1, YES)
        self.assertEqual(self.successResultOf(asked.outcome).sent_at, 0.0)
        later = self.round()
        first = len(self.asked) - 3
        self.clock.advance(0.25)
        self.answer(len(self.asked) - 1, YES)
        self.answer(len(self.asked) - 2, YES)
        self.assertAlmostEqual(self.successResultOf(later.outcome).sent_at, 0.25 + 2 * RETRY_INTERVAL_S)
        self.assertFalse(self.asked[first][2].called)

    def test_strange_and_late_answers(self) -> None:
        """Errors and invalid replies do not count; after ``close`` no request is sent and replies are ignored."""
        asked = self.round()
        self.answer(0, YES)
        self.clock.advance(RETRY_INTERVAL_S)
        self.asked[1][2].errback(NoAnswer("late"))
        self.asked[2][2].callback(["?"])
        self.assertNoResult(asked.outcome)
        self.assertEqual(len(asked.tally.replies), 1)
        asked.close()
        self.answer(-1, YES)
        self.assertEqual((self.clock.getDelayedCalls(), len(asked.tally.replies)), ([], 1))

    def test_answers_at_once(self) -> None:
        """A member on the same node may reply or fail synchronously."""
        for answer, is_won in ((lambda: succeed(pack_reply(YES)), True), (lambda: fail(NoAnswer("x")), False)):
            asked = Round([Tally(3)], lambda _: answer(), decoded, self.clock, 0.5)  # noqa: B023
            self.clock.advance(1.0)
            self.assertEqual(self.successResultOf(asked.outcome).tally.is_won, is_won)

    def test_free_in(self) -> None:
        """The estimated wait ends when the second of the members' leases ends, according to the members' clocks."""
        asked = self.round()
        self.clock.advance(0.04)
        self.answer(0, Reply(ReplyKind.HELD, remaining=0.2))
        self.answer(1, Reply(ReplyKind.HELD, remaining=0.9))
        # A majority needs the second member, because the third has not replied. The remaining time in its reply counts
        # from 0.02, the middle between request and reply.
        self.assertAlmostEqual(asked.estimate_wait(), 0.88)
        unheard = self.round()
        self.clock.advance(0.6)
        self.assertEqual(unheard.estimate_wait(), 0.0)
