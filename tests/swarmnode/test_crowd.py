"""Tests of ``swarmnode.crowd``: real nodes, agents and drivers in a yard for many."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from twisted.trial.unittest import SynchronousTestCase

from sim.crowd.ground import Ground
from sim.crowd.search import search
from swarmnode.crowd import DESK, CrowdTeam

ROOT = Path(__file__).resolve().parents[2]
RUN = """
from sim.crowd.ground import Ground
from sim.crowd.search import search
from swarmnode.crowd import CrowdTeam
print(search(CrowdTeam(4, 3, Ground(30, 5.0, 5.0)), 4, 6.0, lambda: 0.0).digest)
"""


class CrowdTeamTests(SynchronousTestCase):
    def made(self, seed: int, agents: int = 5) -> CrowdTeam:
        """A team among thirty robots on 5 x 5 m."""
        team = CrowdTeam(seed, agents, Ground(30, 5.0, 5.0))
        self.addCleanup(team.stop)
        return team

    def test_search_among_others(self) -> None:
        """The thesis' experiment among many: they search, agree on the nearest that has found it, and it gets there."""
        team = self.made(3)
        self.assertEqual(sorted(team.yard.holders), sorted(team.yard.names))
        outcome = search(team, 3, 120.0, lambda: 0.0)
        self.assertEqual((outcome.engaged is not None, outcome.right), (True, True), outcome)
        self.assertIsNotNone(outcome.reach, outcome)
        crowd, target = team.yard.crowd, team.yard.crowd.target
        assert target is not None
        body = team.yard.names.index(outcome.by)
        self.assertLess(float(crowd.x[body] - target.x) ** 2 + float(crowd.y[body] - target.y) ** 2, 0.4**2)

    def test_seed_replays_it(self) -> None:
        """Two runs of one seed exchange the same datagrams and leave everybody at the same place; another does not."""
        digests = [search(self.made(seed, 3), seed, 6.0, lambda: 0.0).digest for seed in (1, 1, 2)]
        self.assertEqual(digests[0], digests[1])
        self.assertNotEqual(*(half.split("-") for half in digests[1:]))

    def test_order_of_sets_does_not_matter(self) -> None:
        """The hash seed of the interpreter changes nothing: two processes with different ones give the same hash."""
        digests = set()
        for hash_seed in ("1", "4242"):
            environment = {**os.environ, "PYTHONHASHSEED": hash_seed}
            command = [sys.executable, "-c", RUN]
            child = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=120)
            self.assertEqual(child.returncode, 0, child.stderr)
            digests.add(child.stdout.strip())
        self.assertEqual(len(digests), 1, digests)

    def test_names_and_places(self) -> None:
        """The desk has no body, each agent has one, and each node an address of its own."""
        team = self.made(1, 2)
        self.assertEqual(list(team.services), [DESK, "robot1", "robot2"])
        ports = {service.assembly.node.entangled.contact.address for service in team.services.values()}
        self.assertEqual(len(ports), 3)
        self.assertEqual(team.words(), {})
        self.assertIsNone(team.done_by())
