"""Tests of ``middleware.consensus.lease.patience``."""

from __future__ import annotations

from twisted.trial.unittest import SynchronousTestCase

from middleware.consensus.lease.patience import MOST, in_time
from middleware.entangled.clock import HeapClock
from middleware.entangled.quorum.register import Kind, Reply


class InTimeTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.clock = HeapClock()
        self.until = 1.0

    def proposed(self) -> Reply:
        """A member that grants from a moment on."""
        left = self.until - self.clock.seconds()
        return Reply(Kind.HELD, remaining=left) if left > 0.0 else Reply(Kind.GRANTED)

    def test_answers_when_the_lease_ends(self) -> None:
        """What comes a moment too early is granted at the moment from which it may be, not refused."""
        self.clock.advance(1.0 - MOST + 0.01)
        answer = in_time(self.proposed, self.clock)
        self.clock.advance(MOST - 0.02)
        self.assertNoResult(answer)
        self.clock.advance(0.01)
        self.assertEqual(self.successResultOf(answer).kind, Kind.GRANTED)

    def test_a_lease_that_is_renewed(self) -> None:
        """Who was waited for in vain, since the lease goes on, is refused as late as it would have been granted."""
        self.clock.advance(0.95)
        answer = in_time(self.proposed, self.clock)
        self.until = 2.0
        self.clock.advance(0.05)
        self.assertEqual(self.successResultOf(answer).kind, Kind.HELD)

    def test_answers_at_once(self) -> None:
        """Whatever is no matter of a moment is answered now."""
        for reply in (Reply(Kind.GRANTED), Reply(Kind.OUTBID), Reply(Kind.HELD, remaining=MOST + 0.01)):
            self.assertEqual(self.successResultOf(in_time(lambda reply=reply: reply, self.clock)), reply)  # type: ignore[misc]

    def test_nobody_waits_any_more(self) -> None:
        """An answer for which nobody waits any more leaves nothing on the clock, and grants nothing."""
        self.clock.advance(0.95)
        answer = in_time(self.proposed, self.clock)
        answer.addErrback(lambda _: None)
        answer.cancel()
        self.assertEqual(self.clock.getDelayedCalls(), [])
