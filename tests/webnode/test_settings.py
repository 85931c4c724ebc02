"""Tests of ``webnode.routes.settings`` and ``config.tuning``: the settings of running devices."""

from __future__ import annotations

import random
from dataclasses import replace
from typing import Any

from twisted.trial.unittest import SynchronousTestCase

from swarmnode.assembly import assemble_node
from swarmnode.simulated_team import SimulatedTeam
from webnode.errors import Refusal
from webnode.routes.settings import change_settings, read_settings

KEYS = ["description", "presence_lease", "capabilities", "camera_fps"]


class TunerTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.team = SimulatedTeam(4, dogs=("dog1", "dog2"))
        self.addCleanup(self.team.stop)
        self.node = self.team.services["dog1"].assembly.node

    def told(self, name: str = "dog1") -> dict[str, Any]:
        """Return the settings that a device reports."""
        asked = read_settings(self.team.control, self.team.services[name].assembly.node.uuid)
        self.team.clock.advance(0.1)
        return {str(row["key"]): row["value"] for row in self.successResultOf(asked)}

    def change(self, **changes: Any) -> dict[str, Any]:
        """Change settings of dog1; return the settings that dog1 reports."""
        asked = change_settings(self.team.control, self.node.uuid, changes)
        self.team.clock.advance(0.1)
        return {str(row["key"]): row["value"] for row in self.successResultOf(asked)}

    def refusal(self, **changes: Any) -> Refusal:
        """Return the error with which dog1 rejects the changes."""
        asked = change_settings(self.team.control, self.node.uuid, changes)
        self.team.clock.advance(0.1)
        refusal = self.failureResultOf(asked, Refusal).value
        assert isinstance(refusal, Refusal)
        return refusal

    def row(self) -> dict[str, Any]:
        """Return the row of dog1 on the page."""
        return next(dict(row) for row in self.team.state()["devices"] if row["name"] == "dog1")

    def test_tell_what_can_be_changed(self) -> None:
        """A robot with a camera has four settings and a laptop three, each with bounds and a unit."""
        self.assertEqual(list(self.told()), KEYS)
        self.assertEqual(list(self.told("vaio")), KEYS[:3])
        asked = read_settings(self.team.control, self.node.uuid)
        self.team.clock.advance(0.1)
        lease = self.successResultOf(asked)[1]
        self.assertEqual([lease[key] for key in ("value", "unit", "least", "most")], [1.0, "s", 0.1, 60.0])

    def test_change_what_others_see(self) -> None:
        """A changed description, and a changed capability, are visible to the whole team."""
        told = self.change(description="lame", capabilities={"gripper": {"width": 0.1}})
        self.assertEqual((told["description"], told["capabilities"]), ("lame", {"gripper": {"width": 0.1}}))
        self.team.clock.advance(1.0)
        row = self.row()
        self.assertEqual((row["description"], row["capabilities"]["gripper"]), ("lame", {"width": 0.1}))
        self.assertIn("camera", row["capabilities"])
        self.change(capabilities={})
        self.team.clock.advance(1.0)
        self.assertNotIn("gripper", self.row()["capabilities"])

    def test_lease_says_how_soon_a_loss_is_seen(self) -> None:
        """With a lease of 4 s the loss of a failed device is noticed after 3 to 5 s, with one of 0.4 s within 1 s."""
        for lease, earliest, latest in ((4.0, 2.6, 5.0), (0.4, 0.2, 1.0)):
            self.change(presence_lease=lease)
            self.team.clock.advance(6.0)
            self.assertEqual(self.row()["status"], "IDLE")
            self.team.kill("dog1")
            seconds = 0.0
            while self.row()["status"] != "GONE" and seconds < 10.0:
                self.team.clock.advance(0.1)
                seconds += 0.1
            self.assertTrue(earliest < seconds < latest, seconds)
            self.team.add_node("dog1")
            self.team.clock.advance(1.0)
            self.node = self.team.services["dog1"].assembly.node

    def test_camera_takes_as_many_pictures(self) -> None:
        """The camera uses its new frame rate, even 0, and the driver stays ready."""
        driver: Any = self.team.services["dog1"].assembly.driver
        for fps in (2.0, 0.0, 10.0):
            self.assertEqual(self.change(camera_fps=fps)["camera_fps"], fps)
            self.team.clock.advance(0.5)
            before = driver.diagnostics()["pictures"]
            self.team.clock.advance(5.0)
            self.assertAlmostEqual(driver.diagnostics()["pictures"] - before, 5.0 * fps, delta=1.5)
            self.assertEqual(driver.state, "ready")

    def test_refuse_what_is_wrong(self) -> None:
        """The device rejects each invalid value with key, problem and remedy, and changes nothing."""
        before = self.told()
        wrong: list[tuple[str, Any]] = [
            ("presence_lease", 0.01),
            ("presence_lease", float("nan")),
            ("camera_fps", 31.0),
            ("camera_fps", True),
            ("description", "two\nlines"),
            ("description", "x" * 201),
            ("capabilities", {"arm": 3}),
            ("capabilities", {f"arm{n}": {"length": 1.0} for n in range(80)}),
            ("team_key", "stolen"),
        ]
        for key, value in wrong:
            refusal = self.refusal(**{"description": "never", key: value})
            self.assertEqual((refusal.field, refusal.status), (key, 400))
            self.assertTrue(refusal.problem and refusal.remedy)
        self.assertEqual(self.told(), before)

    def test_device_that_is_gone_is_told(self) -> None:
        """If a device has just failed, reading its settings gives status 409."""
        self.team.kill("dog1")
        asked = read_settings(self.team.control, self.node.uuid)
        self.team.clock.advance(2.0)
        self.assertEqual(self.failureResultOf(asked, Refusal).value.status, 409)

    def test_kept_for_the_next_life(self) -> None:
        """Changed settings are stored and survive a restart; an invalid stored value is ignored."""
        self.change(description="lame", presence_lease=2.5)
        service = self.team.services["dog1"]
        seams = replace(service._dependencies, rng=random.Random(1))
        again = assemble_node(service.settings, seams).node
        self.assertEqual((again.presence.device.description, again.entangled.lease), ("lame", 2.5))
        for note in (b"\xc1", b"\x01", b"\x81\xaedescription\x05", b"\x81\xb0presence_lease!!\x05"):
            seams.store.set_note("tuning", note)
            self.assertEqual(assemble_node(service.settings, seams).node.presence.device.description, "")
