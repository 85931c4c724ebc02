"""A simulated team in one process in virtual time: a laptop, three dogs and the robot simulator (``swarm trials``).

The nodes run their production code with in-memory implementations of clock, network and store.
"""

from __future__ import annotations

import random
from collections.abc import Mapping
from typing import Any

from twisted.internet.defer import Deferred

from agents.catalogue import DEMO_TASK, TASKS
from drivers.link import MemoryConnector
from drivers.sim.client import SimulatorClient
from middleware.admission.membership_file import MemoryMembership
from middleware.admission.operator import FIRST_NODE_ROLES, create_operator
from middleware.admission.statement import SECRET_BYTES
from middleware.config.settings import Settings
from middleware.directory.presence import Device, parse_devices
from middleware.entangled.data.memory import MemoryStore
from middleware.entangled.network.network import Address
from middleware.entangled.network.switchboard import LinkConditions
from middleware.faults.kinds import ASSIGN_METHOD, CAUSE_METHOD, Fault, parse_delay
from middleware.frontend.client import TeamClient
from middleware.tasks.task import TASKS as TASKS_KEY
from middleware.tasks.task import find_outcome, group_key, parse_tasks
from sim.demo.trials import main as run_trials
from sim.robots.scene import load_scene
from sim.robots.simulator import RobotSimulator
from sim.team.machine import Machine, MachineConnector, MachineNetwork
from sim.team.simulation import Simulation
from swarmnode.control_client import Rejection
from swarmnode.dependencies import Dependencies
from swarmnode.sandbox import make_memory_channel
from swarmnode.service import NodeService
from webnode.state import DepartedDevices
from webnode.state_builder import build_state
from webnode.team_control import TeamControl

LAN = LinkConditions(delay_s=0.002, jitter_s=0.001)
"""Link quality of an idle home network."""
RESTART_DELAY_S = 15.0
"""Seconds after which a node killed by a fault is restarted, as in the demo."""
DISCOVERY_S = 2.0
REPLY_TIMEOUT_S = 6.0


class SimulatedTeam(Simulation):
    """A laptop and its dogs; a run with the same seed is identical.

    Node, agent, driver, simulator and detection run their production code.  ``dogs`` join at the start; the
    simulator has a robot for each of ``DOGS``.  ``others`` are nodes without a robot, which join before the dogs.
    ``conditions`` applies to every link.  With ``faults`` the nodes accept fault injection.
    """

    BOOTSTRAP = "vaio"
    DOGS = ("dog1", "dog2", "dog3")
    JOIN_INTERVAL_S = 0.3
    SHUTDOWN_S = 1.0

    def __init__(
        self,
        seed: int,
        camera_fps: float = 10.0,
        conditions: LinkConditions = LAN,
        dogs: tuple[str, ...] = DOGS,
        others: tuple[str, ...] = (),
        faults: bool = False,
    ) -> None:
        super().__init__(seed, conditions)
        self.simulator = RobotSimulator(self.clock, random.Random(f"{seed}/yard"), load_scene("three-dogs"))
        self.simulator.start()
        self.services: dict[str, NodeService] = {}
        self.machines: dict[str, Machine] = {}
        self.connectors: dict[str, MemoryConnector] = {}
        self.operator = create_operator(f"team-{seed}", random.Random(f"{seed}/operator"))
        self._member_rng = random.Random(f"{seed}/members")
        self._secret = self._member_rng.randbytes(SECRET_BYTES)
        self._memberships: dict[str, MemoryMembership] = {}
        self._names = (self.BOOTSTRAP, *self.DOGS, *others)
        self._camera_fps = camera_fps
        self._allows_faults = faults
        for name in (self.BOOTSTRAP, *others, *dogs):
            self.add_node(name)
            self.clock.advance(self.JOIN_INTERVAL_S)
        self._simulator_client = SimulatorClient(self.simulator.connector(), self.clock)
        self._simulator_client.connect()
        self.client = TeamClient(self.services[self.BOOTSTRAP].assembly.node)
        self.control = TeamControl(self.client, TASKS, DEMO_TASK, self._simulator_client)
        self._departed = DepartedDevices()
        self.clock.advance(self.JOIN_INTERVAL_S)

    def add_node(self, name: str, tables: Mapping[str, Mapping[str, Any]] | None = None, shelf: Any = None) -> None:
        """Start the node ``name`` (the laptop, a dog or another node) with additional ``tables`` of settings.

        ``shelf`` stores its deployed modules.
        """
        port = self.address_of(name).port
        mapping: dict[str, Any] = {"node": {"name": name, "port": port}}
        if name != self.BOOTSTRAP:
            mapping["node"]["known_nodes"] = [str(self.address_of(self.BOOTSTRAP))]
        if name in self.DOGS:
            mapping["agent"] = {"module": "search"}
            mapping["driver"] = {"kind": "sim", "options": {"robot": name, "camera_fps": self._camera_fps}}
        if self._allows_faults:
            mapping["faults"] = {"allow": True}
        mapping.update(tables or {})
        machine = self.machines[name] = Machine(self.clock)
        connector = self.connectors[name] = self.simulator.connector()
        dependencies = Dependencies(
            machine,
            lambda: MachineNetwork(machine, self.switchboard.make_network(*self.address_of(name))),
            MemoryStore(),
            random.Random(f"{self.seed}/{name}"),
            self.clock.seconds,
            MachineConnector(machine, connector),
            shelf,
            _Process(self, name),
            membership=self._get_membership(name),
            spawn=make_memory_channel,
        )
        self.services[name] = NodeService(Settings.from_mapping(mapping, f"seed {self.seed}"), dependencies)
        self.services[name].startService()

    def _get_membership(self, name: str) -> MemoryMembership:
        """Return the membership of the node ``name``, the same after each restart, issued by the team's operator."""
        if name not in self._memberships:
            roles, now = ("device",) if name in self.DOGS else FIRST_NODE_ROLES, self.clock.seconds()
            membership = self.operator.create_membership(name, roles, now, self._member_rng, self._secret)
            self._memberships[name] = MemoryMembership(membership)
        return self._memberships[name]

    def address(self, place: int) -> Address:
        """Return the address of the node number ``place``."""
        return Address("127.0.0.1", 7000 + place)

    def address_of(self, name: str) -> Address:
        """Return the address of the node ``name``."""
        return self.address(self._names.index(name))

    def run_demo(self) -> str:
        """Press the Run Demo button; returns the task's id."""
        return str(self.control.run_demo())

    def state(self) -> dict[str, Any]:
        """Return the state that the page shows now."""
        return build_state(self.control.read, self._departed, self.BOOTSTRAP, self.clock.seconds())

    def get_true_state(self) -> dict[str, Any]:
        """Return the true positions in the simulator."""
        return self.simulator.world.snapshot()

    def scatter(self, seed: int) -> None:
        """Put the dogs at random places."""
        self.simulator.world.scatter(seed)

    def kill(self, name: str) -> None:
        """End a node as SIGKILL does, without sending anything."""
        self.services[name].vanish()

    def freeze(self, name: str) -> None:
        """Stop a node as SIGSTOP does; its robot, a separate machine, continues."""
        self.machines[name].freeze()

    def unfreeze(self, name: str) -> None:
        """Let a frozen node continue."""
        self.machines[name].thaw()

    def block_datagrams(self, name: str, one_way: bool = False) -> None:
        """Block all datagrams between a node and the other nodes; with ``one_way`` the node still receives."""
        for other in self._names:
            if other != name:
                self.switchboard.cut(self.address_of(name), self.address_of(other), one_way)

    def block_robot_link(self, name: str) -> None:
        """Block all data between a dog's node and its robot, without closing the connection."""
        self.connectors[name].block_data()

    def stop(self) -> None:
        """Stop all nodes and the simulator."""
        for service in self.services.values():
            if service.running:
                service.stopService()
        self.clock.advance(self.SHUTDOWN_S)
        self._simulator_client.disconnect()
        self.simulator.stop()


class _Process:
    def __init__(self, team: SimulatedTeam, name: str) -> None:
        self._team = team
        self._name = name

    def kill(self) -> None:
        self._team.services[self._name].leave_for(RESTART_DELAY_S)

    def freeze(self, seconds: float) -> None:
        self._team.freeze(self._name)
        self._team.clock.callLater(seconds, self._team.unfreeze, self._name)


class SimulatedStage:
    """A simulated team with fault injection at every node; identical runs have the same ``digest``."""

    def __init__(self, seed: int) -> None:
        self.team = SimulatedTeam(seed, faults=True)
        self._node = self.team.services[self.team.BOOTSTRAP].assembly.node
        self._watch = self._node.watch_devices(lambda records: None)
        self.team.clock.advance(DISCOVERY_S)

    def seconds(self) -> float:
        """Return the virtual time in seconds."""
        return self.team.clock.seconds()

    def wait(self, seconds: float) -> None:
        """Advance the virtual time."""
        self.team.clock.advance(seconds)

    def devices(self) -> list[Device]:
        """Return the devices that are online, as seen by the laptop."""
        return [device for device, _ in parse_devices(self._watch.records)]

    def assign(self, task: str) -> str:
        """Publish the task from the laptop."""
        return str(self._call(self._node.presence.device, ASSIGN_METHOD, task))

    def inject(self, device: Device, fault: Fault) -> float:
        """Request the fault through the laptop; return the delay in seconds until it begins."""
        return parse_delay(self._call(device, CAUSE_METHOD, fault.kind, fault.seconds, fault.amount or None))

    def is_over(self, task_id: str) -> bool:
        """Return whether the outcome of the task is recorded."""
        task = parse_tasks(self._wait_for(self._node.entangled.get(TASKS_KEY))).get(task_id)
        records = self._wait_for(self._node.entangled.get(group_key(task_id)))
        return task is not None and find_outcome(task, records) is not None

    def digest(self) -> str:
        """Return the running hash over every delivery."""
        return self.team.switchboard.digest()

    def stop(self) -> None:
        """Stop the team."""
        self.team.stop()

    def _call(self, device: Device, method: str, *arguments: Any) -> Any:
        record = next((record for each, record in parse_devices(self._watch.records) if each.uuid == device.uuid), None)
        contact = None if record is None else self._node.find_contact(record)
        if contact is None:
            raise Rejection(f"{device.name} is not online")
        return self._wait_for(self._node.entangled.call(contact, method, *arguments, changes=True))

    def _wait_for(self, work: Deferred[Any]) -> Any:
        results: list[Any] = []
        problems: list[str] = []
        work.addCallbacks(results.append, lambda failure: problems.append(failure.getErrorMessage()))
        end = self.seconds() + REPLY_TIMEOUT_S
        while not (results or problems) and self.seconds() < end:
            self.wait(0.01)
        if not results:
            raise Rejection(problems[0] if problems else f"no reply within {REPLY_TIMEOUT_S:g} s")
        return results[0]


def main(arguments: list[str]) -> int:
    """Run ``swarm trials``: repeat both experiments with this team."""
    return run_trials(arguments, SimulatedTeam)
