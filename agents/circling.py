"""Circling: walk around a target at the distance kept, in legs that the rangers look ahead on; pure.

A robot sees and ranges only ahead, and one without a ranger stays where it is.  So it turns along the circle, walks a
short chord while the way is open, and turns back to look at the target before the next one.
"""

from __future__ import annotations

import math

from agents.exploration import AIMED, CLEARANCE, TURN_GAIN, Pose, clipped
from agents.formation import CLOSE
from agents.means import Means
from drivers.reading import Action

LONGEST = 0.45
"""Metres of a chord: three seconds' walk of an ERS-7, in which the target is out of sight."""
NEAREST = 0.45
"""Who stands nearer to the target than this stays: it would be in the way."""


class Circling:
    """One robot's way to its post around the target."""

    def __init__(self, means: Means | None = None) -> None:
        self.means = Means() if means is None else means
        self._post: float | None = None
        self._is_blocked = False
        self._heading: float | None = None
        self._leg = 0.0
        self._leg_from: tuple[float, float] | None = None

    def send(self, post: float | None) -> None:
        """Go to ``post`` (radians as seen from the target, by the compass; None: stay)."""
        if post is None or self._post is None or abs(math.remainder(post - self._post, math.tau)) > CLOSE:
            self._post, self._is_blocked = post, False

    @property
    def is_walking(self) -> bool:
        """Whether the robot looks where it walks, and not at the target."""
        return self._heading is not None

    def step(
        self, pose: Pose, target: tuple[float, float], angle: float | None, ahead: float, is_facing: bool
    ) -> Action | None:
        """What to do next on the way; None where the robot is to stand and look at the target.

        ``pose`` and ``target`` are in the robot's odometry, ``angle`` is where it stands as seen from the target,
        ``ahead`` the range ahead, ``is_facing`` whether the target is before its eyes.
        """
        if self._heading is None and not self._begins(pose, target, angle, is_facing):
            return None
        assert self._heading is not None
        off = math.remainder(self._heading - pose[2], math.tau)
        if self._leg_from is None:
            if abs(off) > max(AIMED, self.means.aim):
                return self.means.spin(clipped(TURN_GAIN * off, self.means.look_turn))
            self._leg_from = pose[:2]
        if not math.isnan(ahead) and ahead < CLEARANCE:
            self._is_blocked = True  # a wall, or another robot: this is as near to the post as can be
            return self.rest()
        if math.dist(self._leg_from, pose[:2]) >= self._leg:
            return self.rest()
        return self.means.go(self.means.walk, clipped(TURN_GAIN * off, self.means.look_turn))

    def rest(self) -> Action | None:
        """End the leg; the target is looked at next."""
        self._heading = self._leg_from = None
        return None

    def _begins(self, pose: Pose, target: tuple[float, float], angle: float | None, is_facing: bool) -> bool:
        """Whether a leg begins here, and which."""
        if self._post is None or angle is None or self._is_blocked or not is_facing or not self.means.ranges:
            return False
        way = math.remainder(self._post - angle, math.tau)
        radius = math.dist(pose[:2], target)
        if abs(way) <= CLOSE or radius < NEAREST:
            return False
        outward = math.atan2(pose[1] - target[1], pose[0] - target[0])
        # A chord leans inwards by half the angle that it spans: so the distance stays.
        half = min(abs(way) / 2, math.asin(LONGEST / 2 / radius))
        self._leg = 2 * radius * math.sin(half)
        self._heading = outward + math.copysign(math.pi / 2 + half, way)
        return True
