"""The crowd: agents by the hundred, each with its node, driver and a body in a yard for many (``swarm crowd``).

It wires what the front door wires, with the twins in memory of clock, wire and disk in place of the real ones.
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
"""The node without a body, which assigns the task; everybody else's way in."""
TEAM_KEY = "of a crowd that never leaves one process"
JOINING = 0.1
"""Seconds from one node that joins to the next."""
SETTLING = 2.0
CAMERA_FPS = 5.0
PORT = 7000
TASK = "search"


class CrowdTeam(World):
    """``agents`` in the first bodies of a crowd on ``ground``, and a desk; a seed replays them exactly.

    What runs is what runs on a robot: the real node, agent, driver and detection; the team is an open one.
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
        yard_dice = random.Random(f"{seed}/yard")
        self.yard = CrowdYard(self.clock, yard_dice, ground, agents, controller, stopwatch)
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
        """Where the node of this place listens, each on a machine of its own."""
        return Address(f"10.{place >> 16}.{place >> 8 & 255}.{place & 255}", PORT)

    def assign(self) -> None:
        """Have whoever can do it search the red target."""
        node = self.services[DESK].assembly.node
        self._group = node.watch_group(TASK, lambda records: None, keep=True)
        submitted = Deferred.fromCoroutine(node.submit(task_named(DEMO, TASK, self.clock.seconds())))
        submitted.addCallback(self._submitted)

    def words(self) -> Mapping[str, Word]:
        """What each agent that takes part says, by its name."""
        every = {}
        for name in self.yard.names:
            agent: Any = self.services[name].assembly.agent
            if agent.engagement is not None:
                every[name] = agent.engagement.me
        named = {me.uuid: name for name, me in every.items()}
        return {name: Word(me.cost, named.get(me.assigned, "")) for name, me in every.items()}

    def done_by(self) -> str | None:
        """Who ended the task, None while it is open."""
        if self._group is None or self._task is None:
            return None
        outcome = outcome_of(self._task, self._group.records)
        return None if outcome is None else outcome.by

    def stop(self) -> None:
        """End everything at once: nobody is left to be told."""
        for service in self.services.values():
            service.vanish()
        self.yard.stop()

    def _submitted(self, task: Task) -> None:
        self._task = task

    def _add(self, name: str) -> None:
        number = len(self.services)
        node: dict[str, Any] = {"name": name, "port": PORT, "team_key": TEAM_KEY}
        mapping: dict[str, Any] = {"node": node}
        dice = random.Random(f"{self.seed}/{name}")
        if number:
            # Each joins by somebody who is there: a hundred at one door would only show what that door bears.
            node["known_nodes"] = [str(self.address(dice.randrange(number)))]
            mapping["agent"] = {"module": "search"}
            mapping["driver"] = {"kind": "sim", "options": {"robot": name, "camera_fps": self._fps}}
        network = partial(self.network, number)
        seams = Seams(self.clock, network, self.store(number), dice, self.clock.seconds, self.yard.connector())
        self.services[name] = NodeService(Settings.from_mapping(mapping, f"seed {self.seed}"), seams)
        self.services[name].startService()


def main(arguments: list[str]) -> int:
    """``swarm crowd``."""
    return run_crowd(arguments, CrowdTeam)
