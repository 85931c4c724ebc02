"""Tests of ``middleware.faults.injector.LowBattery``: fault injection of a low battery reading."""

from __future__ import annotations

from typing import Any

from twisted.trial.unittest import SynchronousTestCase

from drivers.driver import Permit
from drivers.link import MemoryConnector
from drivers.reading import Observation
from drivers.sim.driver import SimDriver
from middleware.entangled.clock import HeapClock
from middleware.faults.injector import LowBattery


class _Robot(SimDriver):
    """A robot with an observation that the test sets."""

    def __init__(self) -> None:
        super().__init__({"robot": "dog1"}, MemoryConnector(HeapClock(), lambda *_: None), HeapClock())  # type: ignore
        self.shown = Observation(1.0, 1.0, {"power.level": 0.8, "odom.x": 2.0})
        self.heard: Any = None

    def observe(self) -> Observation:
        return self.shown

    def subscribe(self, seen: Any) -> Any:
        self.heard = seen
        return lambda: None

    def act(self, action: Any, permit: Permit) -> Any:
        return action


class LowBatteryTests(SynchronousTestCase):
    def test_only_the_battery_reads_low(self) -> None:
        """The fault lowers the battery level, if the robot reports a level, and changes no other value."""
        robot = _Robot()
        driver = LowBattery(robot)
        seen: list[Any] = []
        driver.subscribe(seen.append)
        for level, told in ((None, 0.8), (0.03, 0.03), (0.9, 0.8), (None, 0.8)):
            driver.level = level
            observed = driver.observe()
            assert observed is not None
            robot.heard(robot.shown)
            self.assertEqual(dict(observed.values), {"power.level": told, "odom.x": 2.0})
            self.assertEqual(seen[-1], observed)
        robot.shown = Observation(1.0, 1.0, {"odom.x": 2.0})
        driver.level = 0.01
        self.assertIs(driver.observe(), robot.shown)

    def test_all_else_is_the_robot(self) -> None:
        """Description, state, token and actions are passed to and from the robot unchanged."""
        robot = _Robot()
        driver = LowBattery(robot)
        self.assertIs(driver.description, robot.description)
        self.assertEqual((driver.state, driver.token), (robot.state, robot.token))
        self.assertEqual(driver.act({"base.vx": 0.1}, Permit(1, 2.0)), {"base.vx": 0.1})
