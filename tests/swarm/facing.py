"""A behaviour for tests of whole teams; its cost and vote differ for each dog and task."""

from __future__ import annotations

import math
import random
from collections.abc import Mapping

from agents.behaviour import STAND
from agents.context import Context
from drivers.reading import Action, Observation

SPEED = 0.8
NEAR = math.radians(6.0)


class Facing:
    """Turn to the compass direction ``towards`` (radians) at ``speed``; the cost is the angle, rounded to tenths.

    The agent votes for the half of the world that the dog first faced, and offers that direction as its number.
    """

    contexts: list[Context] = []
    """The contexts in which any instance has acted."""

    def __init__(self, parameters: Mapping[str, float | str], rng: random.Random) -> None:
        self._towards = float(parameters["towards"])
        self._speed = float(parameters.get("speed", SPEED))
        self._first: float | None = None
        self._heading = 0.0

    def look(self, seen: Observation, now: float) -> None:
        """Read the compass."""
        self._heading = float(seen.values["compass.heading"])
        self._first = self._heading if self._first is None else self._first

    @property
    def cost(self) -> float | None:
        """Return the angle to turn, in radians; None before the first observation."""
        return None if self._first is None else round(abs(self._way), 1)

    @property
    def choice(self) -> str:
        """Return the vote: the half of the world."""
        return "" if self._first is None else "south" if self._first < 0.0 else "north"

    @property
    def value(self) -> tuple[float, ...]:
        """Return the direction that the dog first faced."""
        return () if self._first is None else (round(self._first, 2),)

    def search(self, now: float) -> Action:
        """Stand still."""
        return STAND

    hold = search

    def execute(self, context: Context) -> Action | None:
        """Turn in the shorter direction."""
        self.contexts.append(context)
        return None if abs(self._way) < NEAR else {**STAND, "base.wz": math.copysign(self._speed, self._way)}

    @property
    def _way(self) -> float:
        return math.remainder(self._towards - self._heading, math.tau)
