"""Short tests of the lease workload: random schedules, their replay, and seeded bugs."""

from __future__ import annotations

from twisted.trial.unittest import SynchronousTestCase

from tests.invariants.bug import FINDERS
from tests.invariants.leases import Leases
from tests.invariants.run import run


class ScheduleTests(SynchronousTestCase):
    def test_no_violation(self) -> None:
        """Twenty schedules with faults violate no invariant; many leases are won and councils changed."""
        wins = changes = 0
        for seed in range(1, 21):
            schedule = Leases(seed)
            self.assertEqual(schedule.run(), [], seed)
            wins += schedule.recorder.wins
            changes += sum(len(charter.changes) for charter in schedule.charters.values())
        self.assertGreater(wins, 100)
        self.assertGreater(changes, 0)

    def test_replay(self) -> None:
        """The same seed gives the same datagrams, and another seed gives different datagrams."""
        digests = [run(seed, ("leases",)).digest for seed in (3, 3, 4)]
        self.assertEqual(digests[0], digests[1])
        self.assertNotEqual(digests[0], digests[2])

    def test_bugs_show(self) -> None:
        """Within a few runs the schedules find each seeded bug (of safety, of liveness, or of the device)."""
        for bug in (
            "a clock that stands still while suspended",
            "the council is whoever is closest now",
            "a stand-by does not ask",
            "the time to stop is ignored",
            "released before it stands still",
        ):
            self.assertEqual(FINDERS[bug], ("leases",))
            self.assertTrue(any(run(seed, ("leases",), bug).found for seed in range(1, 30)), bug)
