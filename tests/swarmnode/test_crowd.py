"""Tests of ``swarmnode.crowd``: real nodes, agents and drivers in the crowd simulator."""

from __future__ import annotations

from twisted.trial.unittest import SynchronousTestCase

from sim.robots.crowd.scene import CrowdScene
from sim.robots.crowd.search import run_search
from swarmnode.crowd import TASK_NODE, CrowdTeam
from tests.replay import replayed

RUN = """
from sim.robots.crowd.scene import CrowdScene
from sim.robots.crowd.search import run_search
from swarmnode.crowd import CrowdTeam
print(run_search(CrowdTeam(4, 3, CrowdScene(30, 5.0, 5.0)), 4, 6.0, lambda: 0.0).digest)
"""


class CrowdTeamTests(SynchronousTestCase):
    def made(self, seed: int, agents: int = 5) -> CrowdTeam:
        """Return a team with robots that are among thirty robots on 5 x 5 m."""
        team = CrowdTeam(seed, agents, CrowdScene(30, 5.0, 5.0))
        self.addCleanup(team.stop)
        return team

    def test_search_among_others(self) -> None:
        """In a crowd, the agents agree on the agent nearest to the target, and its robot reaches the target.

        The control node has no robot, each agent has one robot, and each node has its own address.
        """
        team = self.made(3)
        self.assertEqual(list(team.services), [TASK_NODE, *team.simulator.names])
        self.assertEqual(sorted(team.simulator.driven_robots), sorted(team.simulator.names))
        self.assertEqual(len({each.assembly.node.entangled.contact.address for each in team.services.values()}), 6)
        self.assertEqual((team.get_statuses(), team.find_finisher()), ({}, None))
        outcome = run_search(team, 3, 120.0, lambda: 0.0)
        self.assertEqual((outcome.engaged is not None, outcome.right), (True, True), outcome)
        self.assertIsNotNone(outcome.reach, outcome)
        crowd, target = team.simulator.crowd, team.simulator.crowd.target
        assert target is not None
        body = team.simulator.names.index(outcome.by)
        self.assertLess(float(crowd.x[body] - target.x) ** 2 + float(crowd.y[body] - target.y) ** 2, 0.4**2)

    def test_seed_replays_it(self) -> None:
        """With the same seed, processes with different hash seeds exchange the same datagrams.

        A different seed of the simulation gives a different digest.
        """
        digest = replayed(self, RUN)
        other = run_search(self.made(2, 3), 2, 6.0, lambda: 0.0).digest
        self.assertNotEqual(*(half.split("-") for half in (digest, other)))
