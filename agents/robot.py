"""An agent's robot: connect it through its driver, check that it responds, and move it under a permit."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from twisted.internet.defer import Deferred
from twisted.internet.interfaces import IReactorTime
from twisted.internet.task import deferLater
from twisted.logger import Logger

from agents.detection import run_in_thread
from agents.engagement import RobotCommand
from agents.motion import MotionCapabilities
from drivers.driver import Driver
from drivers.errors import DriverError, LinkError, StaleCommand, UsageError
from drivers.reading import Observation

ENABLE_RETRY_S = 0.5
RESPONSE_TIMEOUT_S = 0.5
"""Seconds without a response after which the agent withdraws its report."""
EMPTY_BATTERY_LEVEL = 0.05
"""Battery charge (0 to 1) below which a robot executes no tasks, so that it can still return."""


class AgentRobot:
    """One robot; ``seen`` is called with each observation, ``missing`` with the reason why no robot is connected."""

    _log = Logger()

    def __init__(
        self,
        driver: Driver,
        clock: IReactorTime,
        seen: Callable[[Observation], None],
        missing: Callable[[str], None],
    ) -> None:
        self.driver = driver
        self.motion = MotionCapabilities(driver.description, run_in_thread(clock))
        self.is_enabled = False
        self._clock = clock
        self._on_observation = seen
        self._on_missing = missing
        self._is_running = False
        self._responded_at = clock.seconds()
        self._permit_ends_at = -math.inf
        self._unsubscribe: Callable[[], None] | None = None

    def start(self) -> None:
        """Connect to the robot and enable its motors."""
        self._is_running = True
        self._unsubscribe = self.driver.subscribe(self._on_observation)
        Deferred.fromCoroutine(self._connect()).addErrback(self._report_missing)

    def stop(self) -> None:
        """Stop the robot and pass on no more observations."""
        self._is_running = False
        self.driver.stop()
        if self._unsubscribe is not None:
            self._unsubscribe()

    @property
    def is_battery_empty(self) -> bool:
        """Whether the robot reports a battery charge below ``EMPTY_BATTERY_LEVEL``; False if it reports none."""
        seen = self.driver.observe()
        charge = None if seen is None else seen.values.get("power.level")
        return isinstance(charge, float | int) and charge < EMPTY_BATTERY_LEVEL

    @property
    def is_estop_engaged(self) -> bool:
        """Whether the robot reports that its own emergency stop keeps the motors off."""
        seen = self.driver.observe()
        return seen is not None and seen.values.get("estop.engaged") is True

    @property
    def is_responding(self) -> bool:
        """Whether the robot responded within ``RESPONSE_TIMEOUT_S``, with its motors enabled and enough charge."""
        if self.is_battery_empty:
            return False
        has_motors = not self.is_estop_engaged
        now = self._clock.seconds()
        if self.is_enabled and has_motors and self.driver.state == "ready":
            self._responded_at = now
        return self.is_enabled and has_motors and now - self._responded_at <= RESPONSE_TIMEOUT_S

    def perform(self, command: RobotCommand) -> bool:
        """Perform ``command``; return False if the robot has obeyed a newer token, so another agent may act."""
        if self.driver.state != "ready":
            return True
        try:
            action = self.motion.remove_missing_axes(command.action)
            self._permit_ends_at = command.permit.deadline
            self.motion.learn(action, self.driver.act(action, command.permit))
        except UsageError as error:
            self.driver.stop()
            self._log.debug("the robot rejected an action: {error}", error=error)
            return not isinstance(error, StaleCommand)
        except DriverError as error:
            self._log.info("the robot does not respond: {error}", error=error)
        return True

    def halt(self) -> float:
        """Stop the robot, and return the number of seconds for which it may still move.

        This is 0 for a reachable robot, and otherwise the remaining time of its last permit. A robot that has no
        permits itself moves until its own timer expires (docs/explanation/stopping-a-robot.md).
        """
        self.driver.stop()
        if not self.driver.description.limits or self.driver.state in ("ready", "stopped"):
            return 0.0
        return max(0.0, self._permit_ends_at - self._clock.seconds())

    async def _connect(self) -> None:
        """Connect and enable the motors; retry if the link is lost."""
        await self.driver.connect()
        while self._is_running and not self.is_enabled:
            try:
                self.is_enabled = await self.driver.enable()
            except LinkError as error:
                self._log.info("motors not enabled yet, retrying: {error}", error=error)
                await deferLater(self._clock, ENABLE_RETRY_S)

    def _report_missing(self, failure: Any) -> None:
        failure.trap(DriverError)
        if self._is_running:
            reason = failure.getErrorMessage()
            self._log.warn("no robot: {reason}", reason=reason)
            self._on_missing(reason)
