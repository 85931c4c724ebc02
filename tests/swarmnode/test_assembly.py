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
        """A node with a driver takes kind and capabilities from the robot; the settings override them."""
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
        """A robot with a camera as part has the capabilities of both, and its pictures can be requested."""
        parts = [{"kind": "camera", "options": {"source": "/pictures"}}]
        driver = {"kind": "create2", "options": {"port": "/dev/robot"}, "parts": parts}
        made = assemble_node(self.settings(driver=driver), MemoryTeam().make_dependencies("a", 7000))
        self.assertTrue({"camera", "bumper"} <= set(made.node.presence.device.capabilities))
        self.assertIsInstance(made.driver, Filming)
        with self.assertRaises(BadSetting) as caught:
            assemble_node(self.settings(driver={"parts": parts}), MemoryTeam().make_dependencies("b", 7001))
        self.assertIn("[driver] parts: are set, but there is no robot", str(caught.exception))

    def test_node_without_body_has_no_agent(self) -> None:
        """A laptop has no driver and no agent, and takes its kind from the settings."""
        made = assemble_node(self.settings(node={"kind": "laptop"}), MemoryTeam().make_dependencies("a", 7000))
        self.assertEqual((made.agent, made.driver, made.node.presence.device.kind), (None, None, "laptop"))

    def test_identity_is_kept_in_the_store(self) -> None:
        """The store keeps the node's identity over restarts with any random generator."""
        store = MemoryStore()
        first = load_identity(store, random.Random(1))
        self.assertEqual(load_identity(store, random.Random(2)).node_id, first.node_id)
        self.assertNotEqual(load_identity(MemoryStore(), random.Random(2)).node_id, first.node_id)

    def test_spoiled_identity_is_made_anew(self) -> None:
        """An invalid stored identity is replaced, so the node starts."""
        store = MemoryStore()
        store.set_note("identity", b"short")
        self.assertEqual(load_identity(store, random.Random(1)).node_id, load_identity(store, random.Random(1)).node_id)

    def test_lost_identity_is_said(self) -> None:
        """A node logs a warning if its existing store has lost the identity, and none if its store is new."""
        lost = MemoryStore()
        lost.origin = "replaced"
        for store, words in ((MemoryStore(), []), (lost, ["the data store has lost the node's identity"])):
            with capturedLogs() as said:
                load_identity(store, random.Random(1))
            self.assertEqual([formatEvent(each).partition(":")[0] for each in said], words)
