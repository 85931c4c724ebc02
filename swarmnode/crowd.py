"""Simulation of hundreds of agents, each with a real node and driver and a robot in the simulator (``swarm crowd``).

The nodes are real ones, with in-memory implementations of clock, network and store.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from twisted.internet.defer import Deferred

from agents.catalogue import DEMO, task_named
from middleware.config.settings import Settings
from middleware.entangled.network.network import Address
from middleware.entangled.replication.watch import Watch
from middleware.tasks.task import Task, outcome_of
from sim.robots.crowd.command import main as run_crowd
from sim.robots.crowd.controller import Controller, wander
from sim.robots.crowd.ground import Ground
from sim.robots.crowd.search import Word
from sim.robots.crowd.yard import CrowdYard
from sim.team.world import World
from swarmnode.rehearsal import LAN
from swarmnode.seams import Seams
from swarmnode.service import NodeService

DESK = "desk"
"""Name of the node without a robot, which assigns the task and is the bootstrap node of all others."""
TEAM_KEY = "of a crowd that never leaves one process"
JOINING = 0.1
"""Seconds between the starts of two nodes."""
SETTLING = 2.0
CAMERA_FPS = 5.0
PORT = 7000
TASK = "search"


class CrowdTeam(World):
    """``agents`` nodes with the first robots of a crowd on ``ground``, and one node without a robot.

    Node, agent, driver and detection are the real ones; the team is open.  A seed reproduces a run exactly.
    """

    def __init__(
        self,
        seed: int,
        agents: int,
        ground: Ground,
        controller: Controller = wander,
        stopwatch: Callable[[], float] = lambda: 0.0,
        camera_fps: float = CAMERA_FPS,
    ) -> None:
        super().__init__(seed, LAN)
        yard_rng = random.Random(f"{seed}/yard")
        self.yard = CrowdYard(self.clock, yard_rng, ground, agents, controller, stopwatch)
        self.yard.start()
        self.services: dict[str, NodeService] = {}
        self._fps = camera_fps
        self._group: Watch | None = None
        self._task: Task | None = None
        for name in (DESK, *self.yard.names):
            self._add(name)
            self.clock.advance(JOINING)
        self.clock.advance(SETTLING)

    def address(self, place: int) -> Address:
        """Return the address of the node ``place``; each node has a separate machine."""
        return Address(f"10.{place >> 16}.{place >> 8 & 255}.{place & 255}", PORT)

    def assign(self) -> None:
        """Assign the task of finding the red target."""
        node = self.services[DESK].assembly.node
        self._group = node.watch_group(TASK, lambda records: None, keep=True)
        submitted = Deferred.fromCoroutine(node.submit(task_named(DEMO, TASK, self.clock.seconds())))
        submitted.addCallback(self._store_task)

    def words(self) -> Mapping[str, Word]:
        """Return the report of each participating agent, by name."""
        every = {}
        for name in self.yard.names:
            agent: Any = self.services[name].assembly.agent
            if agent.engagement is not None:
                every[name] = agent.engagement.me
        named = {me.uuid: name for name, me in every.items()}
        return {name: Word(me.cost, named.get(me.assigned, "")) for name, me in every.items()}

    def done_by(self) -> str | None:
        """Return the name of the agent that ended the task, None while it is open."""
        if self._group is None or self._task is None:
            return None
        outcome = outcome_of(self._task, self._group.records)
        return None if outcome is None else outcome.by

    def stop(self) -> None:
        """Stop all nodes at once, without leaving messages."""
        for service in self.services.values():
            service.vanish()
        self.yard.stop()

    def _store_task(self, task: Task) -> None:
        self._task = task

    def _add(self, name: str) -> None:
        number = len(self.services)
        node: dict[str, Any] = {"name": name, "port": PORT, "team_key": TEAM_KEY}
        mapping: dict[str, Any] = {"node": node}
        rng = random.Random(f"{self.seed}/{name}")
        if number:
            # Each joins through a random earlier node, so the load on a single bootstrap node is not measured.
            node["known_nodes"] = [str(self.address(rng.randrange(number)))]
            mapping["agent"] = {"module": "search"}
            mapping["driver"] = {"kind": "sim", "options": {"robot": name, "camera_fps": self._fps}}
        network = partial(self.network, number)
        seams = Seams(self.clock, network, self.store(number), rng, self.clock.seconds, self.yard.connector())
        self.services[name] = NodeService(Settings.from_mapping(mapping, f"seed {self.seed}"), seams)
        self.services[name].startService()


def main(arguments: list[str]) -> int:
    """Run ``swarm crowd``."""
    return run_crowd(arguments, CrowdTeam)
