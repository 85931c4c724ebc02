"""Tests of how often peers may ask for introductions, and make a node knock."""

from __future__ import annotations

from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.clock import HeapClock
from middleware.entangled.reach.introducer import INTRODUCTIONS, MEETS, MEETS_AT_ONCE, Allowance

ASKER, OTHER, STRANGER = b"a" * 32, b"o" * 32, b"s" * 32


class AllowanceTests(SynchronousTestCase):
    """Behaviour of ``Allowance``."""

    def setUp(self) -> None:
        """An allowance of which nobody has used anything."""
        self.clock = HeapClock()
        self.allowance = Allowance(self.clock)

    def test_each_peer_has_its_own(self) -> None:
        """Who has used up its introductions waits for the next one, and keeps nobody else from any."""
        granted = [self.allowance.may_introduce(ASKER) for _ in range(int(2 * INTRODUCTIONS) + 1)]
        self.assertEqual((sum(granted), granted[-1]), (2 * INTRODUCTIONS, False))
        self.assertTrue(self.allowance.may_introduce(OTHER))
        self.assertTrue(self.allowance.may_meet(ASKER))
        self.clock.advance(1.01 / INTRODUCTIONS)
        self.assertEqual([self.allowance.may_introduce(ASKER) for _ in range(2)], [True, False])

    def test_who_is_met_does_not_count(self) -> None:
        """What an introducer used up comes back once for each peer that answers, and at the pace of strangers else."""
        while self.allowance.may_meet(ASKER):
            self.allowance.introduced(STRANGER, ASKER)
        for public, again in ((OTHER, False), (STRANGER, True), (STRANGER, False)):
            self.allowance.met(public)
            self.assertEqual(self.allowance.may_meet(ASKER), again)
        self.clock.advance(2 * MEETS_AT_ONCE / MEETS)
        granted = [self.allowance.may_meet(ASKER) for _ in range(int(2 * MEETS_AT_ONCE))]
        self.assertEqual(sum(granted), MEETS_AT_ONCE)
