"""Tests of many takers at the same time: nothing is confirmed twice and nothing is lost, whatever dies."""

from __future__ import annotations

from twisted.trial.unittest import SynchronousTestCase

from sim.team.takers.light import LightTrial
from sim.team.takers.trial import Trial

TUPLES = 50


class TakesTests(SynchronousTestCase):
    def _checked(self, trial: Trial) -> Trial:
        trial.play()
        self.assertEqual(trial.violations(), [], f"seed {trial.seed}, loss {trial.storm.loss}")
        trial.stop()
        return trial

    def test_calm(self) -> None:
        """Eight takers share the tuples, and each tuple is told to exactly one of them."""
        trial = self._checked(LightTrial(1, TUPLES))
        self.assertEqual((len(trial.witness.posted), trial.witness.open()), (TUPLES, []))

    def test_loss_churn_and_partitions(self) -> None:
        """Though datagrams are lost, links cut, and takers, members and publishers die: once each, and none lost."""
        for seed, loss, is_churning in ((2, 0.1, False), (4, 0.5, False), (10, 0.4, True), (13, 0.1, True)):
            self._checked(LightTrial(seed, TUPLES, loss, is_churning))

    def test_whole_nodes(self) -> None:
        """So it is with records that are replicated by whole nodes, some of which die, over a wire that loses some."""
        self._checked(Trial(1, 15, 0.1, True, nodes=10))

    def test_members_that_lost_their_memory_keep_silent(self) -> None:
        """A member that comes back without its votes has no say about older tuples, so none is confirmed twice."""
        for seed in range(30, 32):
            trial = ForgottenLife(seed, TUPLES, 0.1, True)
            trial.aftermath = 20.0
            trial.play()
            self.assertEqual([line for line in trial.violations() if line.startswith("T1")], [], f"seed {seed}")
            trial.stop()


class ForgottenLife(LightTrial):
    def start(self, place: int) -> None:
        if place not in self.living:
            self.store(place).note("decree/incarnation", b"")
        super().start(place)
