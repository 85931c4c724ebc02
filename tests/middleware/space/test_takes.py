"""Tests of concurrent takers: each tuple is confirmed at most once and no tuple is lost, even if nodes fail."""

from __future__ import annotations

from twisted.trial.unittest import SynchronousTestCase

from sim.team.takers.shared_store import SharedStoreTrial
from sim.team.takers.trial import TakingTrial

TUPLES = 50


class TakesTests(SynchronousTestCase):
    def _checked(self, trial: TakingTrial) -> TakingTrial:
        trial.run_trial()
        self.assertEqual(trial.find_violations(), [], f"seed {trial.seed}, loss {trial.lossy_conditions.loss}")
        trial.stop()
        return trial

    def test_calm(self) -> None:
        """Eight takers share the tuples, and each tuple is delivered to exactly one taker."""
        trial = self._checked(SharedStoreTrial(1, TUPLES))
        self.assertEqual((len(trial.recorder.tuples), trial.recorder.list_undecided()), (TUPLES, []))

    def test_loss_churn_and_partitions(self) -> None:
        """Each tuple is taken once under datagram loss, partitions and restarts of takers, members and publishers."""
        for seed, loss, is_churning in ((2, 0.1, False), (4, 0.5, False), (10, 0.4, True), (13, 0.1, True)):
            self._checked(SharedStoreTrial(seed, TUPLES, loss, is_churning))

    def test_whole_nodes(self) -> None:
        """Each tuple is taken once if whole nodes replicate the records, datagrams are lost and some nodes fail."""
        self._checked(TakingTrial(1, 15, 0.1, True, nodes=10))

    def test_members_that_lost_their_memory_keep_silent(self) -> None:
        """A member that restarts without its votes does not vote on older tuples, so no tuple is confirmed twice."""
        for seed in range(30, 32):
            trial = ForgottenLife(seed, TUPLES, 0.1, True)
            trial.finish_limit_s = 20.0
            trial.run_trial()
            self.assertEqual([line for line in trial.find_violations() if line.startswith("T1")], [], f"seed {seed}")
            trial.stop()


class ForgottenLife(SharedStoreTrial):
    def start(self, place: int) -> None:
        if place not in self.living:
            self.store(place).set_note("decree/incarnation", b"")
        super().start(place)
