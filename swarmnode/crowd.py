"""Simulation of hundreds of agents, each with a real node and driver and a robot in the simulator (``swarm crowd``).

The nodes run their production code with in-memory implementations of clock, network and store.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from twisted.internet.defer import Deferred

from agents.catalogue import DEMO_TASK, create_task
from middleware.config.settings import Settings
from middleware.entangled.network.network import Address
from middleware.entangled.replication.watch import Watch
from middleware.tasks.task import Task, find_outcome
from sim.robots.crowd.command import main as run_crowd
from sim.robots.crowd.controller import Controller, wander
from sim.robots.crowd.scene import CrowdScene
from sim.robots.crowd.search import AgentStatus
from sim.robots.crowd.simulator import CrowdSimulator
from sim.team.simulation import Simulation
from swarmnode.dependencies import Dependencies
from swarmnode.service import NodeService
from swarmnode.simulated_team import LAN

TASK_NODE = "desk"
"""Name of the first node, which has no robot and assigns the task."""
TEAM_KEY = "of a crowd that never leaves one process"
JOIN_INTERVAL_S = 0.1
"""Seconds between the starts of consecutive nodes."""
SETTLE_S = 2.0
CAMERA_FPS = 5.0
PORT = 7000
TASK_ID = "search"


class CrowdTeam(Simulation):
    """``agents`` nodes with the first robots of a crowd on ``scene``, and one node without a robot.

    Node, agent, driver and detection run their production code; the team is open.  Runs with one seed are identical.
    """

    def __init__(
        self,
        seed: int,
        agents: int,
        scene: CrowdScene,
        controller: Controller = wander,
        stopwatch: Callable[[], float] = lambda: 0.0,
        camera_fps: float = CAMERA_FPS,
    ) -> None:
        super().__init__(seed, LAN)
        yard_rng = random.Random(f"{seed}/yard")
        self.simulator = CrowdSimulator(self.clock, yard_rng, scene, agents, controller, stopwatch)
        self.simulator.start()
        self.services: dict[str, NodeService] = {}
        self._fps = camera_fps
        self._task_watch: Watch | None = None
        self._task: Task | None = None
        for name in (TASK_NODE, *self.simulator.names):
            self._add_node(name)
            self.clock.advance(JOIN_INTERVAL_S)
        self.clock.advance(SETTLE_S)

    def address(self, place: int) -> Address:
        """Return the address of the node number ``place``; each node has a separate machine."""
        return Address(f"10.{place >> 16}.{place >> 8 & 255}.{place & 255}", PORT)

    def assign(self) -> None:
        """Assign the task of finding the red target."""
        node = self.services[TASK_NODE].assembly.node
        self._task_watch = node.watch_group(TASK_ID, lambda records: None, keep=True)
        submitted = Deferred.fromCoroutine(node.submit(create_task(DEMO_TASK, TASK_ID, self.clock.seconds())))
        submitted.addCallback(self._store_task)

    def get_statuses(self) -> Mapping[str, AgentStatus]:
        """Return the report of each participating agent, by name."""
        every = {}
        for name in self.simulator.names:
            agent: Any = self.services[name].assembly.agent
            if agent.engagement is not None:
                every[name] = agent.engagement.me
        named = {me.uuid: name for name, me in every.items()}
        return {name: AgentStatus(me.cost, named.get(me.assigned, "")) for name, me in every.items()}

    def find_finisher(self) -> str | None:
        """Return the name of the agent that ended the task, or None if the task is open."""
        if self._task_watch is None or self._task is None:
            return None
        outcome = find_outcome(self._task, self._task_watch.records)
        return None if outcome is None else outcome.by

    def stop(self) -> None:
        """Stop all nodes immediately; they do not tell their peers that they leave."""
        for service in self.services.values():
            service.vanish()
        self.simulator.stop()

    def _store_task(self, task: Task) -> None:
        self._task = task

    def _add_node(self, name: str) -> None:
        number = len(self.services)
        node: dict[str, Any] = {"name": name, "port": PORT, "team_key": TEAM_KEY}
        mapping: dict[str, Any] = {"node": node}
        rng = random.Random(f"{self.seed}/{name}")
        if number:
            # Each node joins through a random earlier node, so no single bootstrap node limits the result.
            node["known_nodes"] = [str(self.address(rng.randrange(number)))]
            mapping["agent"] = {"module": "search"}
            mapping["driver"] = {"kind": "sim", "options": {"robot": name, "camera_fps": self._fps}}
        network = partial(self.network, number)
        dependencies = Dependencies(
            self.clock, network, self.store(number), rng, self.clock.seconds, self.simulator.connector()
        )
        self.services[name] = NodeService(Settings.from_mapping(mapping, f"seed {self.seed}"), dependencies)
        self.services[name].startService()


def main(arguments: list[str]) -> int:
    """Run ``swarm crowd``."""
    return run_crowd(arguments, CrowdTeam)
