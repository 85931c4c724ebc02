"""Tests with random sequences of events (``tests.invariants.stops``), and a check that they find seeded bugs."""

from __future__ import annotations

from collections import Counter

from twisted.trial.unittest import SynchronousTestCase

from middleware.stop.stop_set import Statement, StopSet
from middleware.stop.stop_state import StopState
from tests.invariants.stops import Violation, run

SEQUENCES = 100
BITING = 40


class SequenceTests(SynchronousTestCase):
    def test_stop_holds(self) -> None:
        """A robot that acknowledged a stop stays still until a release with the id of that stop."""
        counts: Counter[str] = Counter()
        for seed in range(1, SEQUENCES + 1):
            run(seed, counts)
        self.assertEqual(counts["sequences"], SEQUENCES)
        for name in ("acknowledged", "releases", "restarts", "partitions", "hostile", "refused", "repeated", "revoked"):
            self.assertGreater(counts[name], SEQUENCES // 4, name)

    def found(self) -> bool:
        """Return whether one of a few sequences violates an invariant."""
        for seed in range(1, BITING + 1):
            try:
                run(seed, Counter())
            except Violation:
                return True
        return False

    def test_they_bite(self) -> None:
        """The sequences find three bugs: a release ends other stops, any sender can release, stops are not stored."""
        merge = StopSet.merge

        def ends_all(self: StopSet, sender: bytes, order: Statement, may_release: bool = True) -> bool:
            named = tuple(self.in_force) if order.released and may_release else ()
            return merge(self, sender, Statement(order.stops, named, order.by), may_release)

        def by_anybody(self: StopSet, sender: bytes, order: Statement, may_release: bool = True) -> bool:
            return merge(self, sender, order)

        for owner, name, bug in (
            (StopSet, "merge", ends_all),
            (StopSet, "merge", by_anybody),
            (StopState, "_save", lambda self: None),
        ):
            patch = self.patch(owner, name, bug)
            self.assertTrue(self.found(), bug)
            patch.restore()
        self.assertFalse(self.found())
