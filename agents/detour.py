"""Detour: the way round what a robot touched, or what stands before it: back off, turn away, walk on a little; pure."""

from __future__ import annotations

import math

from agents.exploration import AIMED, CLEARANCE, TURN_GAIN, Pose, clipped
from agents.means import Means
from drivers.reading import Action

BACK = 0.10
"""Metres: nothing looks behind."""
BACK_SPEED = 0.08
LEG = 0.35
AWAY = math.radians(70.0)
PATIENCE = 4.0
"""Seconds for each of the three; who is stuck goes on with the next."""


class Detour:
    """One robot's way round something."""

    def __init__(self, means: Means) -> None:
        self.means = means
        self._legs: list[str] = []
        self._heading = 0.0
        self._from: Pose = (0.0, 0.0, 0.0)
        self._since = 0.0

    def is_on(self, now: float) -> bool:
        """Whether the robot is on its way round, and looks elsewhere."""
        return bool(self._legs) and now - self._since <= PATIENCE

    def begin(self, pose: Pose, side: float, now: float, has_touched: bool) -> None:
        """Go round on ``side`` (1: left), from ``pose``; who has touched it backs off first."""
        self._legs = ["back", "turn", "walk"] if has_touched else ["turn", "walk"]
        self._heading = pose[2] + side * AWAY
        self._from, self._since = pose, now

    def end(self) -> None:
        """Look where it is now."""
        self._legs = []

    def step(self, pose: Pose, ahead: float, now: float) -> Action | None:
        """What to do next; None once it is round.  ``ahead`` is the range ahead, NaN: nothing."""
        while self._legs:
            action = None if now - self._since > PATIENCE else self._on_leg(self._legs[0], pose, ahead)
            if action is not None:
                return action
            self._legs.pop(0)
            self._from, self._since = pose, now
        return None

    def _on_leg(self, leg: str, pose: Pose, ahead: float) -> Action | None:
        off = math.remainder(self._heading - pose[2], math.tau)
        way = math.dist(pose[:2], self._from[:2])
        if leg == "back":
            return None if way >= BACK else self.means.go(-BACK_SPEED)
        if leg == "turn":
            is_turned = abs(off) <= max(AIMED, self.means.aim)
            return None if is_turned else self.means.spin(clipped(TURN_GAIN * off, self.means.look_turn))
        is_blocked = not math.isnan(ahead) and ahead < CLEARANCE
        if way >= LEG or is_blocked:
            return None
        return self.means.go(self.means.walk, clipped(TURN_GAIN * off, self.means.look_turn))
