"""Tests of ``swarmnode.simulated_team``: equal seeds give equal runs of a simulated team."""

from __future__ import annotations

from twisted.trial.unittest import SynchronousTestCase

from swarmnode.simulated_team import SimulatedTeam
from tests.replay import replayed

RUN = """
from swarmnode.simulated_team import SimulatedTeam
team = SimulatedTeam(7)
team.run_demo()
team.clock.advance(12.0)
print(team.switchboard.digest())
"""


class ReplayTests(SynchronousTestCase):
    def test_seed_replays_a_team_exactly(self) -> None:
        """With the same seed, processes with different hash seeds exchange the same datagrams.

        A different seed of the simulation gives a different digest.
        """
        digest = replayed(self, RUN)
        self.assertEqual(len(digest), 64)
        team = SimulatedTeam(8)
        team.run_demo()
        team.clock.advance(12.0)
        self.assertNotEqual(team.switchboard.digest(), digest)
