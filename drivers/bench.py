"""Bench: a robot, or its stand-in, on a bench, with a clock that is turned by hand."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Protocol

from twisted.internet.task import Clock

from drivers.driver import Driver
from drivers.link import Link, MemoryConnector, Receiver


class Bench(Protocol):
    """A robot, or its stand-in, on a bench: what the rules need beside the driver.

    ``settle_s`` is how long it may take to connect, to switch the motors, or to close.
    """

    settle_s: float

    def make_driver(self) -> Driver:
        """A fresh driver of the robot that is not connected."""

    def pass_time(self, seconds: float) -> None:
        """Let time pass for driver and robot."""

    def now(self) -> float:
        """The driver's clock, in seconds."""

    def true_speed(self) -> float:
        """How fast the robot really moves, in m/s; asked of those that move."""

    def cut_link(self) -> None:
        """Break the link as a lost network does; it can be opened again.  ``NotImplementedError``: there is none."""


class StandIn(Protocol):
    """An emulated robot as ``MemoryBench`` needs it; it is made with the clock by which it lives."""

    def accept(self, link: Link) -> Receiver:
        """Serve a new link; returns who shall hear what arrives on it."""

    def true_speed(self) -> float:
        """How fast it moves now, in m/s."""


class MemoryBench:
    """A driver and an emulated robot, joined through memory, each by a clock that is turned by hand.

    ``make`` is what makes the driver, as ``drivers.registry`` calls it: (options, name, clock, connector).
    """

    settle_s = 0.3
    STEP_S = 0.005

    def __init__(
        self,
        make: Callable[[Mapping[str, object], str, Any, Any], Driver],
        robot: Callable[[Any], StandIn],
        options: Mapping[str, object],
    ) -> None:
        self._make = make
        self._options = options
        self._clock, self._robots_clock = Clock(), Clock()
        self.robot = robot(self._robots_clock)
        self.connector = MemoryConnector(self._robots_clock, self.robot.accept)

    def make_driver(self) -> Driver:
        """A fresh driver of the robot."""
        return self._make(self._options, "robot", self._clock, self.connector)

    def pass_time(self, seconds: float) -> None:
        """Turn both clocks, in small steps so that answers to answers arrive."""
        for _ in range(round(seconds / self.STEP_S)):
            self._robots_clock.advance(self.STEP_S)
            self._clock.advance(self.STEP_S)

    def now(self) -> float:
        """The driver's clock."""
        return self._clock.seconds()

    def true_speed(self) -> float:
        """What the robot does."""
        return self.robot.true_speed()

    def cut_link(self) -> None:
        """Break the link."""
        self.connector.cut()

    def left_over(self) -> int:
        """How many calls the driver has left on its clock."""
        return len(self._clock.getDelayedCalls())
