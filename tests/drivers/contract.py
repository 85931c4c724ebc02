"""The conformance suite on the drivers here: the test case is the bench, and has some words of its own."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from twisted.internet.task import Clock

from drivers.conformance import Conformance
from drivers.driver import Driver, Permit
from sim.robots.emulator.body import MemoryBody

if TYPE_CHECKING:
    from twisted.trial.unittest import SynchronousTestCase as _Case
else:
    _Case = object


class SensingContract(Conformance, _Case):
    """Conformance of any driver; whoever mixes it in says how one is made and how time passes."""

    def make_driver(self) -> Driver:
        """A fresh driver that is not connected."""
        raise NotImplementedError

    def pass_time(self, seconds: float) -> None:
        """Let time pass for driver and robot."""
        raise NotImplementedError

    def now(self) -> float:
        """The driver's clock."""
        raise NotImplementedError

    def true_speed(self) -> float:
        """How fast the robot really moves, in m/s; those that move say it."""
        raise NotImplementedError

    def cut_link(self) -> None:
        """Break the link as a lost network does; those that have one do it."""
        raise NotImplementedError

    def ready(self) -> Driver:
        """A driver that is connected and enabled."""
        driver = self.make_driver()
        connected = driver.connect()
        self.pass_time(0.3)
        self.successResultOf(connected)
        enabled = driver.enable()
        self.pass_time(0.3)
        self.assertIs(self.successResultOf(enabled), True)
        return driver

    def permit(self, token: int = 1, seconds: float = 0.5) -> Permit:
        """A permit that holds for some seconds from now."""
        return Permit(token, self.now() + seconds)


class DriverContract(SensingContract):
    """Conformance of a driver whose robot moves."""


class BodyContract(DriverContract):
    """Conformance of a driver whose robot is an emulator over a ``MemoryBody``, both on one turned clock."""

    STEP_S = 0.005
    clock: Clock
    body: MemoryBody
    connector: Any

    def pass_time(self, seconds: float) -> None:
        """Turn the clock, and let the body move."""
        for _ in range(round(seconds / self.STEP_S)):
            self.body.pass_time(self.STEP_S)
            self.clock.advance(self.STEP_S)

    def now(self) -> float:
        """The turned clock."""
        return self.clock.seconds()

    def true_speed(self) -> float:
        """What the body really does."""
        return math.hypot(*self.body.motion[:2])

    def cut_link(self) -> None:
        """Break the link, or pull the cable and plug it in again."""
        self.connector.cut()
