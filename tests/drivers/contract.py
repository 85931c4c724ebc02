"""The robots of memory that the tests of drivers use; with ``Conformance`` a test case of them is the bench."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from twisted.internet.task import Clock
from twisted.trial.unittest import SynchronousTestCase

from drivers.driver import Permit
from drivers.reading import Observation
from drivers.registry import driver_for
from sim.robots.emulator.body import MemoryBody


class KeptLink:
    """A link that keeps what is sent."""

    def __init__(self) -> None:
        self.said = b""
        self.is_busy = False
        self.is_closed = False

    def send(self, data: bytes) -> None:
        self.said += data

    def close(self) -> None:
        self.is_closed = True


class KeptLog:
    """A log that keeps its warnings and errors."""

    def __init__(self) -> None:
        self.lines: list[str] = []

    def warn(self, form: str, **values: object) -> None:
        self.lines.append(form.format(**values))

    error = warn

    def debug(self, form: str, **values: object) -> None:
        """Leave it out."""

    info = debug


class RobotCase(SynchronousTestCase):
    """A robot of memory, its drivers, and a clock that is turned by hand; at the end nothing is left on the clock."""

    STEP_S = 0.005
    END_S = 0.1
    """How long the robot may go on after its drivers have left."""
    kind = ""
    options: Mapping[str, object] = {}
    robot: Any = None
    connector: Any = None

    def setUp(self) -> None:
        """A body on an endless floor, and the robot that moves it."""
        self.clock = Clock()
        self.body = MemoryBody()
        self.drivers: list[Any] = []
        self.build()

    def build(self) -> None:
        """Make ``robot`` and ``connector``."""

    def tearDown(self) -> None:
        """Let all drivers go, and switch the robot off."""
        for driver in self.drivers:
            driver.disconnect()
        self.pass_time(self.END_S)
        if self.robot is not None:
            self.robot.stop()
        self.pass_time(self.END_S)
        self.assertEqual(self.clock.getDelayedCalls(), [])

    def make_driver(self, **options: object) -> Any:
        """A fresh driver that is not connected, as the registry makes it."""
        driver = driver_for(self.kind, {**self.options, **options}, "robot", self.clock, self.connector)
        self.drivers.append(driver)
        return driver

    def connected(self, settle: float = 0.3, **options: object) -> Any:
        driver = self.make_driver(**options)
        connected = driver.connect()
        self.pass_time(settle)
        self.successResultOf(connected)
        return driver

    def ready(self, settle: float = 0.3, **options: object) -> Any:
        """A driver that is connected and enabled."""
        driver = self.connected(settle, **options)
        enabled = driver.enable()
        self.pass_time(settle)
        self.assertIs(self.successResultOf(enabled), True)
        return driver

    def permit(self, token: int = 1, seconds: float = 0.5) -> Permit:
        """A permit that holds for some seconds from now."""
        return Permit(token, self.now() + seconds)

    def pass_time(self, seconds: float) -> None:
        """Turn the clock, and let the body move."""
        for _ in range(round(seconds / self.STEP_S)):
            self.body.pass_time(self.STEP_S)
            self.clock.advance(self.STEP_S)

    def now(self) -> float:
        return self.clock.seconds()

    def true_speed(self) -> float:
        return math.hypot(*self.body.motion[:2])

    def cut_link(self) -> None:
        """Break the link; it can be opened again."""
        if self.connector is None:
            raise NotImplementedError
        self.connector.cut()

    def newest(self, driver: Any) -> Observation:
        seen: Observation | None = driver.observe()
        assert seen is not None
        return seen

    def value(self, driver: Any, key: str) -> Any:
        """A value of the newest observation; None where it is not told."""
        return self.newest(driver).values.get(key)

    def near(self, value: Any, wanted: float, off: float = 0.01) -> None:
        """Fail unless a value is as wanted, but for so much."""
        self.assertLessEqual(abs(float(value) - wanted), off)
