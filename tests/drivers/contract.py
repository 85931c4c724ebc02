"""Test cases for robots in memory; a test case that also inherits ``Conformance`` runs the conformance tests."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from twisted.internet.task import Clock
from twisted.trial.unittest import SynchronousTestCase

from drivers.driver import Permit
from drivers.reading import Observation
from drivers.registry import create_driver
from sim.robots.emulator.simulated_robot import MemoryRobot


class KeptLink:
    """A link that records the sent bytes."""

    def __init__(self) -> None:
        self.said = b""
        self.is_busy = False
        self.is_closed = False

    def send(self, data: bytes) -> None:
        self.said += data

    def close(self) -> None:
        self.is_closed = True


class KeptLog:
    """A log that records warnings and errors."""

    def __init__(self) -> None:
        self.lines: list[str] = []

    def warn(self, form: str, **values: object) -> None:
        self.lines.append(form.format(**values))

    error = warn

    def debug(self, form: str, **values: object) -> None:
        """Ignore the message."""

    info = debug


class RobotCase(SynchronousTestCase):
    """A robot in memory, its drivers, and virtual time; no delayed calls may remain after a test."""

    STEP_S = 0.005
    END_S = 0.1
    """The time in seconds that the robot may need to stop after its drivers have disconnected."""
    kind = ""
    options: Mapping[str, object] = {}
    robot: Any = None
    connector: Any = None

    def setUp(self) -> None:
        """Create a simulated base and the robot that moves it."""
        self.clock = Clock()
        self.body = MemoryRobot()
        self.drivers: list[Any] = []
        self.build()

    def build(self) -> None:
        """Create ``robot`` and ``connector``."""

    def tearDown(self) -> None:
        """Disconnect all drivers, and stop the robot."""
        for driver in self.drivers:
            driver.disconnect()
        self.pass_time(self.END_S)
        if self.robot is not None:
            self.robot.stop()
        self.pass_time(self.END_S)
        self.assertEqual(self.clock.getDelayedCalls(), [])

    def make_driver(self, **options: object) -> Any:
        """Return a new driver, not yet connected, created by the registry."""
        driver = create_driver(self.kind, {**self.options, **options}, "robot", self.clock, self.connector)
        self.drivers.append(driver)
        return driver

    def connected(self, settle: float = 0.3, **options: object) -> Any:
        driver = self.make_driver(**options)
        connected = driver.connect()
        self.pass_time(settle)
        self.successResultOf(connected)
        return driver

    def ready(self, settle: float = 0.3, **options: object) -> Any:
        """Return a driver that is connected and enabled."""
        driver = self.connected(settle, **options)
        enabled = driver.enable()
        self.pass_time(settle)
        self.assertIs(self.successResultOf(enabled), True)
        return driver

    def permit(self, token: int = 1, seconds: float = 0.5) -> Permit:
        """Return a permit that is valid for ``seconds``."""
        return Permit(token, self.now() + seconds)

    def pass_time(self, seconds: float) -> None:
        """Advance the clock and the base."""
        for _ in range(round(seconds / self.STEP_S)):
            self.body.advance(self.STEP_S)
            self.clock.advance(self.STEP_S)

    def now(self) -> float:
        return self.clock.seconds()

    def true_speed(self) -> float:
        return math.hypot(*self.body.motion[:2])

    def cut_link(self) -> None:
        """Break the link; the driver can open a new link."""
        if self.connector is None:
            raise NotImplementedError
        self.connector.cut()

    def newest(self, driver: Any) -> Observation:
        seen: Observation | None = driver.observe()
        assert seen is not None
        return seen

    def value(self, driver: Any, key: str) -> Any:
        """Return a value of the newest observation, or None if it is missing."""
        return self.newest(driver).values.get(key)

    def near(self, value: Any, wanted: float, off: float = 0.01) -> None:
        """Fail if a value of the newest observation differs from the expected value by more than ``off``."""
        self.assertLessEqual(abs(float(value) - wanted), off)
