"""Body: an agent's robot behind its driver: woken, watched for whether it answers, and moved under a permit."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from twisted.internet.defer import Deferred
from twisted.internet.interfaces import IReactorTime
from twisted.internet.task import deferLater
from twisted.logger import Logger

from agents.detection import run_in_thread
from agents.engagement import Deed
from agents.means import Means
from drivers.driver import Driver
from drivers.errors import DriverError, LinkError, StaleCommand, UsageError
from drivers.reading import Observation

WAKE_AGAIN = 0.5
PATIENCE = 0.5
"""Seconds for which a robot may fall silent before its agent takes its report back."""
EMPTY = 0.05
"""Charge (0 to 1) below which a robot is as good as silent: it goes home while it still can."""


class Body:
    """One robot; ``seen`` is called with what it senses, ``missing`` with why there is none."""

    _log = Logger()

    def __init__(
        self,
        driver: Driver,
        clock: IReactorTime,
        seen: Callable[[Observation], None],
        missing: Callable[[str], None],
    ) -> None:
        self.driver = driver
        self.means = Means(driver.description, run_in_thread(clock))
        self.is_awake = False
        self._clock = clock
        self._seen = seen
        self._missing = missing
        self._is_running = False
        self._answered_at = clock.seconds()
        self._ends_at = -math.inf
        self._unsubscribe: Callable[[], None] | None = None

    def start(self) -> None:
        """Connect, and have the motors on."""
        self._is_running = True
        self._unsubscribe = self.driver.subscribe(self._seen)
        Deferred.fromCoroutine(self._wake()).addErrback(self._no_body)

    def stop(self) -> None:
        """Stand still, and tell nothing any more."""
        self._is_running = False
        self.driver.stop()
        if self._unsubscribe is not None:
            self._unsubscribe()

    @property
    def is_empty(self) -> bool:
        """Whether the robot says that it has hardly any charge left; one that does not say has enough."""
        seen = self.driver.observe()
        charge = None if seen is None else seen.values.get("power.level")
        return isinstance(charge, float | int) and charge < EMPTY

    @property
    def is_off(self) -> bool:
        """Whether the robot's own switch keeps its motors off, as far as it says."""
        seen = self.driver.observe()
        return seen is not None and seen.values.get("estop.engaged") is True

    @property
    def answers(self) -> bool:
        """Whether the robot answers with its motors on and some charge left, or did so a moment ago."""
        if self.is_empty:
            return False
        has_motors = not self.is_off
        now = self._clock.seconds()
        if self.is_awake and has_motors and self.driver.state == "ready":
            self._answered_at = now
        return self.is_awake and has_motors and now - self._answered_at <= PATIENCE

    def do(self, deed: Deed) -> bool:
        """Do it; False where the robot has obeyed a newer token, which means that another may act."""
        if self.driver.state != "ready":
            return True
        try:
            action = self.means.fitted(deed.action)
            self._ends_at = deed.permit.deadline
            self.means.did(action, self.driver.act(action, deed.permit))
        except UsageError as error:
            self.driver.stop()
            self._log.debug("the body refused: {error}", error=error)
            return not isinstance(error, StaleCommand)
        except DriverError as error:
            self._log.info("the body does not answer: {error}", error=error)
        return True

    def halt(self) -> float:
        """Stand still; returns for how many seconds it may still move where it does not hear that: as its permit says.

        A robot that knows no permits moves for as long as its own timer lets it (docs/explanation/stopping-a-robot.md).
        """
        self.driver.stop()
        if not self.driver.description.limits or self.driver.state in ("ready", "stopped"):
            return 0.0
        return max(0.0, self._ends_at - self._clock.seconds())

    async def _wake(self) -> None:
        """Have the body connected and its motors on; a link that goes away in between is tried again."""
        await self.driver.connect()
        while self._is_running and not self.is_awake:
            try:
                self.is_awake = await self.driver.enable()
            except LinkError as error:
                self._log.info("motors not on yet: {error}", error=error)
                await deferLater(self._clock, WAKE_AGAIN)

    def _no_body(self, failure: Any) -> None:
        failure.trap(DriverError)
        if self._is_running:
            reason = failure.getErrorMessage()
            self._log.warn("no robot: {reason}", reason=reason)
            self._missing(reason)
