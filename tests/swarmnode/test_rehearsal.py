"""Tests of ``swarmnode.rehearsal``: a team that a seed replays."""

from __future__ import annotations

from twisted.trial.unittest import SynchronousTestCase

from swarmnode.rehearsal import VirtualTeam
from tests.replay import replayed

RUN = """
from swarmnode.rehearsal import VirtualTeam
team = VirtualTeam(7)
team.run_demo()
team.clock.advance(12.0)
print(team.board.digest())
"""


class ReplayTests(SynchronousTestCase):
    def digest(self, seed: int, seconds: float) -> str:
        """The trace of a team's run."""
        team = VirtualTeam(seed)
        team.run_demo()
        team.clock.advance(seconds)
        team.stop()
        return team.board.digest()

    def test_seed_replays_a_team_exactly(self) -> None:
        """Two runs of one seed exchange the same datagrams at the same moments; another seed gives another run."""
        self.assertEqual(self.digest(5, 8.0), self.digest(5, 8.0))
        self.assertNotEqual(self.digest(5, 1.0), self.digest(6, 1.0))

    def test_order_of_sets_does_not_matter(self) -> None:
        """The hash seed of the interpreter changes nothing: two processes with different ones give the same trace."""
        self.assertEqual(len(replayed(self, RUN)), 64)
