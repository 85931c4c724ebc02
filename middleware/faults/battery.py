"""A robot whose battery level reads low; everything else of its driver is unchanged."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

LEVEL = "power.level"


class LowBattery:
    """Forward everything to ``driver``, but report at most ``level`` (0 to 1) as its charge; None: the real charge.

    The robot still obeys commands; its agent has to give up the task.
    """

    def __init__(self, driver: Any) -> None:
        self.level: float | None = None
        self._driver = driver

    def __getattr__(self, name: str) -> Any:
        return getattr(self._driver, name)

    def observe(self) -> Any:
        """Return the newest observation with the limited level; None before the first."""
        return self._limit(self._driver.observe())

    def subscribe(self, seen: Callable[[Any], None]) -> Callable[[], None]:
        """Call ``seen`` with each observation with the limited level; the result ends the subscription."""
        end: Callable[[], None] = self._driver.subscribe(lambda observation: seen(self._limit(observation)))
        return end

    def _limit(self, seen: Any) -> Any:
        level = None if seen is None else seen.values.get(LEVEL)
        if self.level is None or not isinstance(level, float | int) or level <= self.level:
            return seen
        return replace(seen, values={**seen.values, LEVEL: self.level})
