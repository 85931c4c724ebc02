"""Turn around on the spot; the robot with the highest battery charge does it."""

from __future__ import annotations

import math
import random
from collections.abc import Mapping

from agents.context import Context
from agents.exploration import clip
from agents.motion import STAND, MotionCapabilities
from drivers.reading import Action, Observation

TURN_RATE_RADPS = 1.2
MAX_TURNS = 100.0


class TurnAround:
    """Turn on the spot; no target is needed.

    The cost is the part of the battery charge that has been used, 0 to 1.  The parameter ``turns`` is the number of
    turns (default 1).
    """

    def __init__(self, parameters: Mapping[str, float | str], rng: random.Random) -> None:
        self._turns = float(parameters.get("turns", 1.0))
        if not 0.0 <= self._turns <= MAX_TURNS:
            raise ValueError(f"turns must be 0 to {MAX_TURNS:g}, is {self._turns:g}")
        self._motion = MotionCapabilities()
        self._charge: float | None = None
        self._yaw: float | None = None
        self._turned_rad = 0.0
        self._is_acting = False

    def embody(self, motion: MotionCapabilities) -> None:
        """Use the motion capabilities of this robot."""
        self._motion = motion

    def look(self, seen: Observation, now: float) -> None:
        """Process the battery charge and the heading."""
        self._charge = float(seen.values.get("power.level", math.nan))
        yaw = float(seen.values.get("odom.yaw", 0.0))
        if self._yaw is not None and self._is_acting:
            self._turned_rad += math.remainder(yaw - self._yaw, math.tau)
        self._yaw = yaw

    @property
    def cost(self) -> float | None:
        """The part of the battery charge that has been used, 0 to 1."""
        return None if self._charge is None or math.isnan(self._charge) else round(1.0 - self._charge, 4)

    def search(self, now: float) -> Action:
        """Stand still: there is nothing to search for."""
        return STAND

    def hold(self, now: float) -> Action:
        """Stand still."""
        self._is_acting = False
        return STAND

    @property
    def progress(self) -> float:
        """The share of the turns that is done."""
        return 1.0 if not self._turns else self._turned_rad / (self._turns * math.tau)

    def execute(self, context: Context) -> Action | None:
        """Turn left until the turns are complete; turns under an earlier lease of this robot count as well."""
        if not context.is_resumed:
            self._yaw = None  # turns between two leases are not part of this task
        self._is_acting = True
        is_done = self._turned_rad >= self._turns * math.tau
        return None if is_done else self._motion.spin(clip(TURN_RATE_RADPS, self._motion.turn))
