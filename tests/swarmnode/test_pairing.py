"""Tests of Table 5.1 of the thesis as settings files: each robot has a laptop and an agent."""

from __future__ import annotations

import random
from dataclasses import replace
from functools import partial
from pathlib import Path

import msgpack
from twisted.logger import ILogObserver, LogEvent, formatEvent, globalLogPublisher
from twisted.trial.unittest import SynchronousTestCase
from zope.interface import implementer

from agents.catalogue import DEMO_TASK, TASKS
from drivers.registry import describe
from middleware.config.settings import Settings
from middleware.directory.presence import Device
from middleware.frontend.client import TeamClient
from sim.robots.emulator.aibo_dog import AiboEmulator
from sim.robots.emulator.simulated_robot import MemoryRobot
from swarmnode.service import NodeService
from tests.swarmnode.team import MemoryTeam
from webnode.state import DepartedDevices, make_device_view
from webnode.state_builder import build_state
from webnode.team_control import TeamControl

FOLDER = Path(__file__).resolve().parents[2] / "examples" / "table-5.1"
ROWS = [(f"dog{n}", f"dog{n}_laptop", f"dog{n}_agent") for n in (1, 2, 3)]


class PairingTests(SynchronousTestCase):
    def setUp(self) -> None:
        """Load the four files."""
        self.settings = {file.stem: Settings.load(str(file)) for file in sorted(FOLDER.glob("*.toml"))}

    def test_files_are_the_table(self) -> None:
        """Each row has a file with device, laptop and agent; each dog has its own address, and each laptop one dog."""
        self.assertEqual(list(self.settings), ["dog1", "dog2", "dog3", "vaio"])
        dogs = [self.settings[name] for name, _, _ in ROWS]
        self.assertEqual([(each.node.name, each.node.laptop, each.agent.name) for each in dogs], ROWS)
        for each in dogs:
            body = describe(each.driver.kind, each.driver.options, each.node.name)
            self.assertEqual(body.kind, "aibo-ers7")
        self.assertEqual(len({str(each.driver.options["host"]) for each in dogs}), 3)
        self.assertEqual(len({each.node.host for each in self.settings.values()}), 4)

    def test_files_are_a_team(self) -> None:
        """All nodes have the same key; each dog joins through the laptop vaio, which is a bootstrap and web node."""
        vaio = self.settings["vaio"]
        self.assertEqual((set(vaio.node.roles), vaio.driver.kind), ({"bootstrap", "edge", "web"}, ""))
        for each in self.settings.values():
            self.assertEqual(each.node.team_secret, vaio.node.team_secret)
            known = [] if each is vaio else [(vaio.node.host, vaio.node.port)]
            self.assertEqual([(address.host, address.port) for address in each.node.known_nodes], known)

    def test_team_tells_who_belongs_together(self) -> None:
        """With these files and emulated dogs, page and log contain device, laptop and agent, and all dogs connect."""
        lines: list[str] = []

        @implementer(ILogObserver)
        def seen(event: LogEvent) -> None:
            lines.append(formatEvent(event))

        globalLogPublisher.addObserver(seen)
        self.addCleanup(globalLogPublisher.removeObserver, seen)
        team = MemoryTeam()
        services: dict[str, NodeService] = {}
        for port, (name, settings) in enumerate(sorted(self.settings.items(), reverse=True), 7000):
            dependencies = team.make_dependencies(name, port)
            host = settings.node.host
            dependencies = replace(dependencies, network=partial(team.switchboard.make_network, host, port))
            if settings.driver.kind:
                dog = AiboEmulator(team.clock, MemoryRobot(), random.Random(name))
                dog.start()
                self.addCleanup(dog.stop)
                dependencies = replace(dependencies, connector=dog.connector())
            settings = replace(settings, node=replace(settings.node, store=":memory:"))
            services[name] = NodeService(settings, dependencies, [])
            services[name].startService()
            self.addCleanup(services[name].stopService)
            team.clock.advance(1.0)
        team.clock.advance(3.0)
        control = TeamControl(TeamClient(services["vaio"].assembly.node), TASKS, DEMO_TASK, None)
        devices = build_state(control.read, DepartedDevices(), "vaio", team.clock.seconds())["devices"]
        told = {device["name"]: (device["name"], device["laptop"], device["agent"]) for device in devices}
        self.assertEqual(told, {"vaio": ("vaio", "vaio", ""), **{row[0]: row for row in ROWS}})
        self.assertEqual({device["kind"] for device in devices}, {"laptop", "aibo-ers7"})
        for device, laptop, agent in ROWS:
            self.assertIn(f"agent of {device}: {agent} on {laptop}", lines)
            driver = services[device].assembly.driver
            assert driver is not None
            self.assertEqual(driver.state, "ready")

    def test_names_cost_nothing_where_there_are_none(self) -> None:
        """The record of a device without these names lacks their keys; names that are not text are ignored."""
        bare, named = Device("ab", "dog1"), Device("ab", "dog1", laptop="dog1_laptop", agent="dog1_agent")
        keys = [set(msgpack.unpackb(device.pack())) for device in (bare, named)]
        self.assertEqual(keys[0] ^ keys[1], {"laptop", "agent"})
        self.assertEqual(make_device_view({"name": "dog1", "laptop": 7})["laptop"], "")
