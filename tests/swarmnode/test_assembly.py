"""Tests of ``swarmnode.assembly``: the node that results from settings."""

from __future__ import annotations

import random
from typing import Any

from twisted.logger import capturedLogs, formatEvent
from twisted.trial.unittest import SynchronousTestCase

from drivers.driver import Filming
from middleware.config.settings import Settings
from middleware.entangled.data.memory import MemoryStore
from middleware.errors import BadSetting
from swarmnode.assembly import assemble_node, load_identity
from tests.swarmnode.team import KEY, MemoryTeam


class AssemblyTests(SynchronousTestCase):
    def settings(self, **tables: Any) -> Settings:
        """Return settings of a node called a."""
        return Settings.from_mapping(
            {"node": {"name": "a", "team_key": KEY, **tables.pop("node", {})}, **tables}, "test"
        )

    def test_driver_brings_kind_and_capabilities(self) -> None:
        """A node with a driver gets kind and capabilities from the robot, unless the settings override them."""
        team = MemoryTeam()
        settings = self.settings(
            node={"capabilities": {"base2d": {"max": 1}, "horn": {}}},
            driver={"kind": "sim"},
            agent={"module": "search"},
        )
        made = assemble_node(settings, team.make_dependencies("a", 7000))
        device = made.node.presence.device
        self.assertEqual(device.kind, "aibo-ers7")
        self.assertEqual(device.capabilities["base2d"], {"max": 1})
        self.assertEqual(
            set(device.capabilities), {"base2d", "horn", "odometry", "compass", "ranger", "imu", "power"} | {"camera"}
        )
        self.assertIsNotNone(made.agent)

    def test_parts_bring_their_capabilities(self) -> None:
        """A robot that has a camera as a part has the capabilities of both, and serves pictures."""
        parts = [{"kind": "camera", "options": {"source": "/pictures"}}]
        driver = {"kind": "create2", "options": {"port": "/dev/robot"}, "parts": parts}
        made = assemble_node(self.settings(driver=driver), MemoryTeam().make_dependencies("a", 7000))
        self.assertTrue({"camera", "bumper"} <= set(made.node.presence.device.capabilities))
        self.assertIsInstance(made.driver, Filming)
        with self.assertRaises(BadSetting) as caught:
            assemble_node(self.settings(driver={"parts": parts}), MemoryTeam().make_dependencies("b", 7001))
        self.assertIn("[driver] parts: are set, but there is no robot", str(caught.exception))

    def test_node_without_body_has_no_agent(self) -> None:
        """A laptop has neither a driver nor an agent, and its kind is set in the settings."""
        made = assemble_node(self.settings(node={"kind": "laptop"}), MemoryTeam().make_dependencies("a", 7000))
        self.assertEqual((made.agent, made.driver, made.node.presence.device.kind), (None, None, "laptop"))

    def test_identity_is_kept_in_the_store(self) -> None:
        """The store preserves the node's identity over restarts, whatever the random generator returns."""
        store = MemoryStore()
        first = load_identity(store, random.Random(1))
        self.assertEqual(load_identity(store, random.Random(2)).node_id, first.node_id)
        self.assertNotEqual(load_identity(MemoryStore(), random.Random(2)).node_id, first.node_id)

    def test_spoiled_identity_is_made_anew(self) -> None:
        """A node with an invalid stored identity gets a new identity and starts."""
        store = MemoryStore()
        store.set_note("identity", b"short")
        self.assertEqual(load_identity(store, random.Random(1)).node_id, load_identity(store, random.Random(1)).node_id)

    def test_lost_identity_is_said(self) -> None:
        """A node logs a warning if an existing store has lost the identity, but not if the store is new."""
        lost = MemoryStore()
        lost.origin = "replaced"
        for store, words in ((MemoryStore(), []), (lost, ["the data store has lost the node's identity"])):
            with capturedLogs() as said:
                load_identity(store, random.Random(1))
            self.assertEqual([formatEvent(each).partition(":")[0] for each in said], words)
