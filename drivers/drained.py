"""Drained: a robot whose battery can be made to read low while everything else of it stays as it is."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

from twisted.internet.defer import Deferred

from drivers.driver import Driver, Permit
from drivers.reading import Action, Description, Observation, Value

POWER = "power.level"


class DrainedDriver:
    """``driver`` as it is, but that ``level``, where it is not None, is the highest charge (0 to 1) it tells of."""

    def __init__(self, driver: Driver) -> None:
        self.level: float | None = None
        self._driver = driver

    @property
    def description(self) -> Description:
        """What the robot is."""
        return self._driver.description

    @property
    def state(self) -> str:
        """Where the link stands."""
        return self._driver.state

    @property
    def token(self) -> int:
        """The highest token that the robot has obeyed."""
        return self._driver.token

    def connect(self) -> Deferred[Description]:
        """Open the link."""
        return self._driver.connect()

    def disconnect(self) -> Deferred[None]:
        """Stop the motion, then close."""
        return self._driver.disconnect()

    def enable(self) -> Deferred[bool]:
        """Motors on."""
        return self._driver.enable()

    def disable(self) -> Deferred[bool]:
        """Motors off."""
        return self._driver.disable()

    def act(self, action: Action, permit: Permit) -> Action:
        """Do it: a battery that reads low still moves the robot, it is the agent that is to give up."""
        return self._driver.act(action, permit)

    def stop(self) -> Action:
        """Zero motion now."""
        return self._driver.stop()

    def observe(self) -> Observation | None:
        """The newest observation, drained."""
        seen = self._driver.observe()
        return None if seen is None else self._drained(seen)

    def subscribe(self, seen: Callable[[Observation], None]) -> Callable[[], None]:
        """Call ``seen`` at each observation, drained."""
        return self._driver.subscribe(lambda observation: seen(self._drained(observation)))

    def invoke(self, name: str, **arguments: float | str) -> Deferred[Mapping[str, Value]]:
        """Have the robot do it."""
        return self._driver.invoke(name, **arguments)

    def diagnostics(self) -> dict[str, float]:
        """Counters of the robot."""
        return self._driver.diagnostics()

    def _drained(self, seen: Observation) -> Observation:
        level = seen.values.get(POWER)
        if self.level is None or not isinstance(level, float | int) or level <= self.level:
            return seen
        return replace(seen, values={**seen.values, POWER: self.level})
