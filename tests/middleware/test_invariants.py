"""Tests of some schedules of ``tests.invariants``, and of the seeded bugs that they find.

``make schedules`` runs 2,000 schedules.
"""

from __future__ import annotations

from twisted.trial.unittest import SynchronousTestCase

from sim.team.schedule import Schedule
from sim.team.shrinking import Reduction
from sim.team.sqlite_files import SqliteTeam
from tests.invariants.bug import FINDERS, seeded
from tests.invariants.leases import Leases
from tests.invariants.records import Records
from tests.invariants.run import WORKLOADS, least, line, run, run_all
from tests.invariants.tasks import Tasks
from tests.replay import replayed

BITING = {
    "no hand-over": (1, "D1"),
    "a take is not noted": (1, "T3"),
    "the window moves before the tag is checked": (1, "R1"),
    "no tie-break": (1, "C1"),
}
"""Some bugs that are found quickly, each with a seed and the invariant that it violates.

``make bugs`` tests all bugs.
"""
ALL = tuple(WORKLOADS)
SHRUNK = 16
"""The seed of a schedule that fails because of a seeded bug."""
DIGEST = "from tests.middleware.test_invariants import digests; print(digests())"


def digests() -> list[str]:
    """Return the digests of datagrams and events of three runs: all workloads, tasks, and leases."""
    schedule, tasks, leases = Schedule(1, SqliteTeam), Tasks(3), Leases(3)
    schedule.run([workload(schedule) for workload in WORKLOADS.values()])
    tasks.run()
    leases.run()
    histories = [schedule.history, tasks.history, leases.recorder.history]
    return [schedule.team.switchboard.digest(), *(history.digest() for history in histories)]


class InvariantTests(SynchronousTestCase):
    def found(self, seed: int) -> list[str]:
        schedule = Schedule(seed)
        return schedule.run([Records(schedule)])

    def test_schedules(self) -> None:
        """Eight random schedules of loss, partitions, kills and restarts violate no invariant of the records."""
        failed = {seed: found for seed in range(5001, 5009) if (found := self.found(seed))}
        self.assertEqual(failed, {})

    def test_all_workloads(self) -> None:
        """A schedule of all workloads (records, tuples, hostile datagrams, disk errors) violates no invariant."""
        self.assertEqual({seed: found for seed in (7,) if (found := run(seed, ALL).found)}, {})

    def test_whole_agents(self) -> None:
        """Fifteen schedules of whole agents differ, and violate no invariant of tasks and decisions (E4 to E7).

        The agents join, leave, fail, pause and cancel.
        """
        outcomes = [run(seed, ("tasks",)) for seed in range(7001, 7016)]
        self.assertEqual({outcome.seed: outcome.found for outcome in outcomes if outcome.found}, {})
        self.assertGreater(len({outcome.digest for outcome in outcomes}), 13)
        self.assertEqual(outcomes[0], run(7001, ("tasks",)))

    def test_bugs_have_their_places(self) -> None:
        """Each seeded bug replaces an attribute of the code, and this attribute exists."""
        for bug in FINDERS:
            with self.subTest(bug=bug), seeded(bug):
                pass

    def test_bugs_are_found(self) -> None:
        """A schedule with a seeded bug violates the invariant that is listed for this bug."""
        blind = []
        for bug, (seed, invariant) in BITING.items():
            found = run(seed, FINDERS[bug], bug).found
            if not any(line.startswith(invariant) for line in found):
                blind.append((bug, found[:2]))
        self.assertEqual(blind, [])

    def test_same_in_every_process(self) -> None:
        """Runs produce the same datagrams and events in every process, regardless of string hash randomization."""
        replayed(self, DIGEST)

    def test_order(self) -> None:
        """A run does not depend on earlier runs in the same process."""
        wanted = [(seed, only) for only in (("records",), ("tasks",), ("leases",), ("groups",)) for seed in (3,)]
        outcomes = [run(seed, only) for seed, only in wanted]
        self.assertEqual([run(seed, only) for seed, only in reversed(wanted)], outcomes[::-1])

    def test_shrunk(self) -> None:
        """A failing schedule is reduced to the necessary faults; the printed command line reproduces the failure."""
        bug = "votes forgotten by a restart"
        whole = run(SHRUNK, ("tuples", "deciders"), bug)
        left = least(whole, bug)
        self.assertEqual(left.trim.only, ("tuples",))
        self.assertTrue(left.trim.calm)
        assert left.trim.keep is not None
        self.assertLess(len(left.trim.keep), whole.faults)
        self.assertEqual(run(SHRUNK, (), bug, left.trim), left.outcome)
        self.assertTrue(any(violation.startswith("T4: ") for violation in left.outcome.found))
        for number in left.trim.keep:
            fewer = Reduction(tuple(one for one in left.trim.keep if one != number), only=("tuples",))
            self.assertFalse(any(violation.startswith("T4: ") for violation in run(SHRUNK, (), bug, fewer).found))
        self.assertIn(
            f"--seed {SHRUNK} --only tuples --keep {','.join(map(str, left.trim.keep))} --calm", line(SHRUNK, left.trim)
        )

    def test_jobs(self) -> None:
        """Several processes return the same outcomes in the same order as a single process."""
        seeds = range(1, 4)
        self.assertEqual(list(run_all(seeds, 2, ("records",))), [run(seed, ("records",)) for seed in seeds])
