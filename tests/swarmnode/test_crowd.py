"""Tests of ``swarmnode.crowd``: real nodes, agents and drivers in the crowd simulator."""

from __future__ import annotations

from twisted.trial.unittest import SynchronousTestCase

from sim.robots.crowd.ground import Ground
from sim.robots.crowd.search import search
from swarmnode.crowd import DESK, CrowdTeam
from tests.replay import replayed

RUN = """
from sim.robots.crowd.ground import Ground
from sim.robots.crowd.search import search
from swarmnode.crowd import CrowdTeam
print(search(CrowdTeam(4, 3, Ground(30, 5.0, 5.0)), 4, 6.0, lambda: 0.0).digest)
"""


class CrowdTeamTests(SynchronousTestCase):
    def made(self, seed: int, agents: int = 5) -> CrowdTeam:
        """Return a team among thirty robots on 5 x 5 m."""
        team = CrowdTeam(seed, agents, Ground(30, 5.0, 5.0))
        self.addCleanup(team.stop)
        return team

    def test_search_among_others(self) -> None:
        """The thesis' experiment in a crowd: the agents agree on the nearest, which reaches the target.

        The desk has no robot, each agent has one, and each node has its own address.
        """
        team = self.made(3)
        self.assertEqual(list(team.services), [DESK, *team.yard.names])
        self.assertEqual(sorted(team.yard.holders), sorted(team.yard.names))
        self.assertEqual(len({each.assembly.node.entangled.contact.address for each in team.services.values()}), 6)
        self.assertEqual((team.words(), team.done_by()), ({}, None))
        outcome = search(team, 3, 120.0, lambda: 0.0)
        self.assertEqual((outcome.engaged is not None, outcome.right), (True, True), outcome)
        self.assertIsNotNone(outcome.reach, outcome)
        crowd, target = team.yard.crowd, team.yard.crowd.target
        assert target is not None
        body = team.yard.names.index(outcome.by)
        self.assertLess(float(crowd.x[body] - target.x) ** 2 + float(crowd.y[body] - target.y) ** 2, 0.4**2)

    def test_seed_replays_it(self) -> None:
        """Processes with different hash seeds exchange the same datagrams; another seed gives another digest."""
        digest = replayed(self, RUN)
        other = search(self.made(2, 3), 2, 6.0, lambda: 0.0).digest
        self.assertNotEqual(*(half.split("-") for half in (digest, other)))
