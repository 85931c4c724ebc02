"""Tests of ``drivers.phone``: a device that sees, and that whoever holds it moves."""

from __future__ import annotations

import math

from twisted.internet.task import Clock
from twisted.trial.unittest import SynchronousTestCase

from drivers.driver import Permit
from drivers.errors import LinkLost, NotEnabled, StaleCommand, Unsupported, UsageError
from drivers.phone.driver import PhoneDriver
from drivers.registry import describe, driver_for
from tests.drivers.contract import SensingContract

JPEG = b"\xff\xd8 a picture \xff\xd9"


class PhoneDriverTests(SensingContract, SynchronousTestCase):
    """A phone keeps the contract of what senses, and what is its own."""

    def setUp(self) -> None:
        """A clock that is turned by hand, and phones that look ten times a second while time passes."""
        self.clock = Clock()
        self.drivers: list[PhoneDriver] = []

    def make_driver(self) -> PhoneDriver:
        """A phone that tells everything."""
        driver = PhoneDriver({"orientation": True, "position": True}, self.clock)
        self.drivers.append(driver)
        return driver

    def pass_time(self, seconds: float) -> None:
        """Turn the clock, with looks on the way."""
        for _ in range(round(seconds / 0.05)):
            self.clock.advance(0.05)
            for driver in self.drivers:
                driver.look(JPEG, 208, 156, {})

    def now(self) -> float:
        """The turned clock."""
        return self.clock.seconds()

    def test_says_what_it_has(self) -> None:
        """Of the capabilities a phone has the camera always, the others where its browser tells them; no motion."""
        everything = describe("phone", {"orientation": True, "position": True})
        self.assertEqual(sorted(everything.capabilities), ["camera", "orientation", "position"])
        self.assertEqual(everything.limits, {})
        upright = describe("phone", {"width": 120, "height": 208})
        self.assertEqual(list(upright.capabilities), ["camera"])
        self.assertEqual(upright.capabilities["camera"]["fov_v_deg"], 65.0)
        self.assertIsInstance(driver_for("phone", {}, "anna", self.clock), PhoneDriver)

    def test_names_the_wrong_option(self) -> None:
        """Each wrong option is refused in a line that names its key."""
        for key, value in (("width", 8), ("height", 641), ("width", 20.0), ("orientation", 1), ("colour", "red")):
            self.assertIn(key, str(self.assertRaises(UsageError, describe, "phone", {key: value})))

    def test_tells_where_it_sees_the_target(self) -> None:
        """What the page measured is in the observation with its picture; where it saw no target, that is NaN."""
        driver = self.make_driver()
        driver.look(JPEG, 208, 156, {})
        self.assertIsNone(driver.observe(), "nothing is taken before connect")
        driver.connect()
        driver.look(JPEG, 208, 156, {"target.bearing": 0.1, "target.distance": 0.5, "orientation.yaw": 2.0})
        seen = driver.observe()
        assert seen is not None and seen.frame is not None
        self.assertEqual((seen.values["target.distance"], seen.values["orientation.yaw"]), (0.5, 2.0))
        self.assertEqual((seen.frame.width, seen.frame.height, seen.frame.data), (208, 156, JPEG))
        driver.look(JPEG, 208, 156, {})
        seen = driver.observe()
        assert seen is not None
        self.assertTrue(math.isnan(float(seen.values["target.bearing"])))

    def test_goes_stale_and_comes_back(self) -> None:
        """Half a second without a look is stale; the next look is the phone again, and counts as a reconnection."""
        driver = self.ready()
        self.clock.advance(PhoneDriver.STALE_S + 0.01)
        self.assertEqual(driver.state, "stale")
        self.assertRaises(NotEnabled, driver.act, {}, self.permit())
        self.failureResultOf(driver.enable(), LinkLost)
        self.pass_time(0.1)
        self.assertEqual((driver.state, driver.diagnostics()["reconnects"]), ("ready", 1.0))

    def test_can_do_nothing_lawfully(self) -> None:
        """The empty action is done under a lawful permit; any other is unsupported, an old token is refused."""
        driver = self.ready()
        self.assertEqual(driver.act({}, self.permit(token=5)), {})
        self.assertEqual(driver.token, 5)
        self.assertRaises(Unsupported, driver.act, {"base.vx": 0.0}, self.permit(token=6))
        self.assertRaises(StaleCommand, driver.act, {}, self.permit(token=4))
        self.assertRaises(StaleCommand, driver.act, {}, Permit(6, self.now()))

    def test_can_be_switched_off(self) -> None:
        """Disabled it goes on sensing and acts on nothing; enable lifts that."""
        driver = self.ready()
        self.successResultOf(driver.disable())
        self.assertEqual(driver.state, "stopped")
        self.assertRaises(NotEnabled, driver.act, {}, self.permit())
        self.successResultOf(driver.enable())
        self.assertEqual(driver.act({}, self.permit()), {})

    def test_leaves_before_its_first_look(self) -> None:
        """Who waits for a phone that never looked is told that it left."""
        driver = self.make_driver()
        waiting = driver.connect()
        driver.disconnect()
        self.failureResultOf(waiting, LinkLost)
        driver.look(JPEG, 208, 156, {})
        self.assertIsNone(driver.observe())
