"""Tests of ``drivers.phone``: a device with a camera and without motors."""

from __future__ import annotations

import math

from drivers.conformance import Conformance
from drivers.errors import LinkLost, NotEnabled
from drivers.phone.driver import PhoneDriver
from drivers.registry import create_driver, describe
from tests.drivers.contract import RobotCase

JPEG = b"\xff\xd8 a picture \xff\xd9"


class PhoneDriverTests(Conformance, RobotCase):
    """The phone driver passes the conformance tests for sensors and further tests of its functions."""

    STEP_S = 0.05
    kind = "phone"
    options = {"orientation": True, "position": True}

    def pass_time(self, seconds: float) -> None:
        """Advance the clock; each phone sends 20 frames per second."""
        for _ in range(round(seconds / self.STEP_S)):
            self.clock.advance(self.STEP_S)
            for driver in self.drivers:
                driver.process_picture(JPEG, 208, 156, {})

    def test_says_what_it_has(self) -> None:
        """The capabilities are the camera, and orientation and position if the browser reports them, but no motion."""
        everything = describe("phone", {"orientation": True, "position": True})
        self.assertEqual(sorted(everything.capabilities), ["camera", "orientation", "position"])
        self.assertEqual(everything.limits, {})
        upright = describe("phone", {"width": 120, "height": 208})
        self.assertEqual(list(upright.capabilities), ["camera"])
        self.assertEqual(upright.capabilities["camera"]["fov_v_deg"], 65.0)
        self.assertIsInstance(create_driver("phone", {}, "anna", self.clock), PhoneDriver)

    def test_tells_where_it_sees_the_target(self) -> None:
        """An observation with a frame contains the page's measurements of the target; without a target they are NaN."""
        driver = self.make_driver()
        driver.process_picture(JPEG, 208, 156, {})
        self.assertIsNone(driver.observe(), "nothing is taken before connect")
        driver.connect()
        driver.process_picture(JPEG, 208, 156, {"target.bearing": 0.1, "target.distance": 0.5, "orientation.yaw": 2.0})
        seen = driver.observe()
        assert seen is not None and seen.frame is not None
        self.assertEqual((seen.values["target.distance"], seen.values["orientation.yaw"]), (0.5, 2.0))
        self.assertEqual((seen.frame.width, seen.frame.height, seen.frame.data), (208, 156, JPEG))
        driver.process_picture(JPEG, 208, 156, {})
        seen = driver.observe()
        assert seen is not None
        self.assertTrue(math.isnan(float(seen.values["target.bearing"])))

    def test_goes_stale_and_comes_back(self) -> None:
        """After half a second without a frame the phone is stale; the next frame counts as a reconnect."""
        driver = self.ready()
        self.clock.advance(PhoneDriver.STALE_S + 0.01)
        self.assertEqual(driver.state, "stale")
        self.assertRaises(NotEnabled, driver.act, {}, self.permit())
        self.failureResultOf(driver.enable(), LinkLost)
        self.pass_time(0.1)
        self.assertEqual((driver.state, driver.diagnostics()["reconnects"]), ("ready", 1.0))
