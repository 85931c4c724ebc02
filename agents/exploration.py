"""Exploration: look all around, then walk to a new place where the way is open, and look around again; pure.

Knows ranges and the robot's own odometry, and not what is searched for.
"""

from __future__ import annotations

import math
import random

from agents.means import STAND, Means
from drivers.reading import Action

TURN_GAIN = 2.2
LEG = 0.6
"""Metres to walk before looking around again."""
CLEARANCE = 0.38
"""Metres ahead at which a leg ends: something is in the way."""
OPEN = 1.5
"""A way with nothing within this range, the far ranger's, is as open as can be told."""
AIMED = math.radians(8.0)
HERE = 0.5
"""A bump not farther away than that says that its heading is no way from here either."""
BUMPS = 3

Pose = tuple[float, float, float]


class Exploration:
    """One robot's way through an unknown place; ``pose`` is its odometry (x, y in metres, yaw in radians)."""

    def __init__(self, rng: random.Random, means: Means | None = None) -> None:
        self.means = Means() if means is None else means
        self._rng = rng
        self._side = rng.choice((-1.0, 1.0))
        self._turned = 0.0
        self._openness: list[tuple[float, float]] = []
        self._heading: float | None = None
        self._leg_from: tuple[float, float] | None = None
        self._bumps: list[Pose] = []
        self.sector: tuple[float, float] | None = None
        """The middle and the width of the headings that are this robot's to search; None: all."""

    def saw(self, pose: Pose, turned: float, ahead: float) -> None:
        """Take in the pose, the turn since the last time, and the range ahead (NaN: nothing within reach)."""
        if self._heading is None:
            self._turned += abs(turned)
            self._openness.append((OPEN if math.isnan(ahead) else ahead, pose[2]))

    def bumped(self, pose: Pose) -> None:
        """Something was touched at ``pose``: end the leg, and for as long as it is near walk another way."""
        self._bumps = [*self._bumps, pose][-BUMPS:]
        self._begin_turn()

    def step(self, pose: Pose, ahead: float) -> Action:
        """What to do next."""
        if self._heading is None:
            if self._turned < math.tau:
                return self.means.spin(self._side * self.means.look_turn)
            self._heading = self._most_open(pose)
        off = math.remainder(self._heading - pose[2], math.tau)
        if self._leg_from is None:
            if abs(off) > max(AIMED, self.means.aim):
                return self.means.spin(clipped(TURN_GAIN * off, self.means.look_turn))
            self._leg_from = pose[:2]
        is_blocked = not math.isnan(ahead) and ahead < CLEARANCE
        if is_blocked or math.dist(self._leg_from, pose[:2]) >= LEG:
            self._begin_turn()
            return STAND
        return self.means.go(self.means.walk, clipped(TURN_GAIN * off, self.means.look_turn))

    def _most_open(self, pose: Pose) -> float:
        """A heading with room ahead and beside it, in the own sector if there is one; chance decides among the best."""
        seen = self._openness
        if self.sector is not None:
            middle, width = self.sector
            own = [(o, yaw) for o, yaw in seen if abs(math.remainder(yaw - middle, math.tau)) <= width / 2]
            seen = own if any(openness >= CLEARANCE + LEG for openness, _ in own) else seen
        shut = [bump[2] for bump in self._bumps if math.dist(bump[:2], pose[:2]) <= HERE]
        free = [one for one in seen if all(abs(math.remainder(one[1] - yaw, math.tau)) > math.pi / 3 for yaw in shut)]
        seen = free or seen
        best = max(openness for openness, _ in seen)
        return self._rng.choice([yaw for openness, yaw in seen if openness >= 0.95 * best])

    def _begin_turn(self) -> None:
        self._turned = 0.0
        self._openness = []
        self._heading = None
        self._leg_from = None
        self._side = self._rng.choice((-1.0, 1.0))


def clipped(value: float, limit: float) -> float:
    """``value``, or ``limit`` with its sign where it is larger."""
    return max(-limit, min(limit, value))
