"""The rehearsal: a laptop, three dogs and their yard in one process, on one turned clock (``swarm trials``).

It wires what the front door wires, with the twins in memory of clock, wire and disk in place of the real ones.
"""

from __future__ import annotations

import random
from collections.abc import Mapping
from functools import partial
from typing import Any

from agents.catalogue import DEMO, TASKS
from drivers.sim.operator import YardOperator
from middleware.entangled.clock import HeapClock
from middleware.entangled.data.memory import MemoryStore
from middleware.entangled.network.switchboard import Switchboard, Weather
from middleware.settings import Settings
from sim.demo.trials import main as run_trials
from sim.scene import loaded
from sim.yard import Yard
from swarmnode.assembly import Seams
from swarmnode.service import NodeService
from webnode.ledger import state_from
from webnode.state import Departed
from webnode.team import TeamDesk


class VirtualTeam:
    """A laptop and its dogs; a seed replays them exactly.

    What runs is what runs on a robot: the real node, agent, driver, yard and detection.  ``dogs`` are those that are
    there from the start, the yard has a body for each of ``DOGS``; ``delay`` in seconds and ``loss`` (0 to 1) are those
    of a datagram.
    """

    BOOTSTRAP = "vaio"
    DOGS = ("dog1", "dog2", "dog3")
    JOINING = 0.3

    def __init__(
        self,
        seed: int,
        camera_fps: float = 10.0,
        delay: float = 0.002,
        loss: float = 0.0,
        dogs: tuple[str, ...] = DOGS,
    ) -> None:
        self.clock = HeapClock()
        weather = Weather(delay_s=delay, jitter_s=delay / 2, loss=loss)
        self.board = Switchboard(self.clock, random.Random(f"{seed}/board"), weather)
        self.yard = Yard(self.clock, random.Random(f"{seed}/yard"), loaded("three-dogs"))
        self.yard.start()
        self.services: dict[str, NodeService] = {}
        self._seed = seed
        self._fps = camera_fps
        for name in (self.BOOTSTRAP, *dogs):
            self.add(name)
            self.clock.advance(self.JOINING)
        self._operator = YardOperator(self.yard.connector(), self.clock)
        self._operator.connect()
        self.desk = TeamDesk(self.services[self.BOOTSTRAP].assembly.node, TASKS, DEMO, self._operator)
        self._departed = Departed()
        self.clock.advance(self.JOINING)

    def add(self, name: str, tables: Mapping[str, Mapping[str, Any]] | None = None, shelf: Any = None) -> None:
        """Start the node ``name``, the laptop or one of the dogs, with further ``tables`` of settings.

        ``shelf`` is where it keeps deployed modules.
        """
        place = (self.BOOTSTRAP, *self.DOGS).index(name)
        port = 7000 + place
        mapping: dict[str, Any] = {"node": {"name": name, "port": port, "team_key": str(self._seed)}}
        if place:
            mapping["node"]["known_nodes"] = ["127.0.0.1:7000"]
            mapping["agent"] = {"module": "search"}
            mapping["driver"] = {"kind": "sim", "options": {"robot": name, "camera_fps": self._fps}}
        mapping.update(tables or {})
        seams = Seams(
            self.clock,
            partial(self.board.network, "127.0.0.1", port),
            MemoryStore(),
            random.Random(f"{self._seed}/{name}"),
            self.clock.seconds,
            self.yard.connector(),
            shelf,
        )
        self.services[name] = NodeService(Settings.from_mapping(mapping, f"seed {self._seed}"), seams)
        self.services[name].startService()

    def run_demo(self) -> str:
        """Press the Run Demo button; returns the task's id."""
        return self.desk.run_demo()

    def state(self) -> dict[str, Any]:
        """What the page shows now."""
        return state_from(self.desk.read, self._departed, self.BOOTSTRAP, self.clock.seconds())

    def truth(self) -> dict[str, Any]:
        """Where everything in the yard really is."""
        return self.yard.world.snapshot()

    def scatter(self, seed: int) -> None:
        """Set the dogs down at random places."""
        self.yard.world.scatter(seed)

    def kill(self, name: str) -> None:
        """End a node as SIGKILL does: without a word to anybody."""
        self.services[name].vanish()

    def stop(self) -> None:
        """End everything."""
        for service in self.services.values():
            if service.running:
                service.stopService()
        self._operator.disconnect()
        self.yard.stop()


def main(arguments: list[str]) -> int:
    """``swarm trials``: both experiments with this team, many times."""
    return run_trials(arguments, VirtualTeam)
