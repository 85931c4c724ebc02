"""A few dozen schedules of ``tests.invariants``, and a look at whether they bite."""

from __future__ import annotations

from twisted.trial.unittest import SynchronousTestCase

from tests.invariants.bug import seeded
from tests.invariants.records import Records
from tests.invariants.schedule import Schedule

BITING = {
    "tombstone dropped too early": (4, "D4"),
    "acknowledged by a minority": (1, "D1"),
    "lower sequence accepted": (3, "D4"),
    "contact entered unchecked": (13, "D5"),
    "no hand-over": (1, "D1"),
    "absent members do not count": (1, "D1"),
    "nothing instead of unavailable": (1, "D1"),
    "signature not checked": (2, "D4"),
    "a read from the own store counts as sure": (4, "D1"),
    "numbers start again after a restart": (337, "D"),
    "any answer counts": (1, "D1"),
}
"""A seed that shows each bug, and an invariant that it breaks."""


class InvariantTests(SynchronousTestCase):
    def found(self, seed: int) -> list[str]:
        """The violations of one schedule."""
        schedule = Schedule(seed)
        return schedule.run([Records(schedule)])

    def test_schedules(self) -> None:
        """Two dozen random schedules of loss, cuts, kills and restarts break no invariant of the records."""
        failed = {seed: found for seed in range(5001, 5025) if (found := self.found(seed))}
        self.assertEqual(failed, {})

    def test_they_bite(self) -> None:
        """Each bug that is put in turns a schedule red that is green without it."""
        blind = []
        for bug, (seed, invariant) in BITING.items():
            with seeded(bug):
                if not any(line.startswith(invariant) for line in self.found(seed)):
                    blind.append(bug)
        self.assertEqual(blind, [])

    def test_replay(self) -> None:
        """The same seed gives the same run, datagram by datagram."""
        digests = []
        for _ in range(2):
            schedule = Schedule(7)
            schedule.run([Records(schedule)])
            digests.append(schedule.fleet.board.digest())
        self.assertEqual(digests[0], digests[1])
