"""Explore an unknown area: look around, walk in an open direction, and go around obstacles; pure.

The exploration uses only ranges and the robot's odometry, not the target.
"""

from __future__ import annotations

import math
import random

from agents.motion import STAND, MotionCapabilities
from drivers.reading import Action

TURN_GAIN = 2.2
LEG_M = 0.6
"""Metres to walk before looking around again."""
CLEARANCE_M = 0.38
"""Metres ahead at which a leg ends because of an obstacle."""
OPEN_RANGE_M = 1.5
"""Range in metres of the far ranger: a direction is open if it has no obstacle within this range."""
AIM_TOLERANCE_RAD = math.radians(8.0)
BUMP_RADIUS_M = 0.5
"""Metres within which a bump excludes its heading."""
MAX_BUMPS = 3
BACK_OFF_M = 0.10
"""Metres that the robot backs off at the start of a detour: a short distance, because no sensor looks behind."""
BACK_OFF_SPEED_MPS = 0.08
DETOUR_LEG_M = 0.35
DETOUR_TURN_RAD = math.radians(70.0)
DETOUR_LEG_TIMEOUT_S = 4.0
"""Seconds for each of the three legs of a detour; a stuck robot continues with the next leg."""

Pose = tuple[float, float, float]


class Exploration:
    """Exploration by one robot; a ``pose`` is its odometry: x and y in metres, yaw in radians."""

    def __init__(self, rng: random.Random, motion: MotionCapabilities | None = None) -> None:
        self.motion = MotionCapabilities() if motion is None else motion
        self._rng = rng
        self._side = rng.choice((-1.0, 1.0))
        self._turned_rad = 0.0
        self._openness: list[tuple[float, float]] = []
        self._heading: float | None = None
        self._leg_from: tuple[float, float] | None = None
        self._bumps: list[Pose] = []
        self.sector: tuple[float, float] | None = None
        """The middle and the width of the sector of headings that this robot searches; None: all headings."""

    def update(self, pose: Pose, turned: float, ahead: float) -> None:
        """Process the pose, the turn since the last call, and the range ahead (NaN: nothing in range)."""
        if self._heading is None:
            self._turned_rad += abs(turned)
            self._openness.append((OPEN_RANGE_M if math.isnan(ahead) else ahead, pose[2]))

    def on_bump(self, pose: Pose) -> None:
        """Process a bump at ``pose``: end the leg, and avoid its heading as long as the robot is near that pose."""
        self._bumps = [*self._bumps, pose][-MAX_BUMPS:]
        self._start_looking()

    def step(self, pose: Pose, ahead: float) -> Action:
        """Return the next action."""
        if self._heading is None:
            if self._turned_rad < math.tau:
                return self.motion.spin(self._side * self.motion.look_turn)
            self._heading = self._choose_heading(pose)
        off = math.remainder(self._heading - pose[2], math.tau)
        if self._leg_from is None:
            if (turn := turn_to(self.motion, off)) is not None:
                return turn
            self._leg_from = pose[:2]
        if is_blocked(ahead) or math.dist(self._leg_from, pose[:2]) >= LEG_M:
            self._start_looking()
            return STAND
        return walk_to(self.motion, off)

    def _choose_heading(self, pose: Pose) -> float:
        """Return a random one of the headings with a large range, in the robot's own sector if possible."""
        seen = self._openness
        if self.sector is not None:
            middle, width = self.sector
            own = [(o, yaw) for o, yaw in seen if abs(math.remainder(yaw - middle, math.tau)) <= width / 2]
            seen = own if any(openness >= CLEARANCE_M + LEG_M for openness, _ in own) else seen
        blocked_headings = [bump[2] for bump in self._bumps if math.dist(bump[:2], pose[:2]) <= BUMP_RADIUS_M]
        free = [
            one
            for one in seen
            if all(abs(math.remainder(one[1] - yaw, math.tau)) > math.pi / 3 for yaw in blocked_headings)
        ]
        seen = free or seen
        best = max(openness for openness, _ in seen)
        return self._rng.choice([yaw for openness, yaw in seen if openness >= 0.95 * best])

    def _start_looking(self) -> None:
        self._turned_rad = 0.0
        self._openness = []
        self._heading = None
        self._leg_from = None
        self._side = self._rng.choice((-1.0, 1.0))


class Detour:
    """A detour around an obstacle: back off, turn away, and walk on a little."""

    def __init__(self, motion: MotionCapabilities) -> None:
        self.motion = motion
        self._legs: list[str] = []
        self._heading = 0.0
        self._from: Pose = (0.0, 0.0, 0.0)
        self._since = 0.0

    def is_active(self, now: float) -> bool:
        """Return whether the robot is on the detour, and therefore does not look at the target."""
        return bool(self._legs) and now - self._since <= DETOUR_LEG_TIMEOUT_S

    def start(self, pose: Pose, side: float, now: float, has_touched: bool) -> None:
        """Start a detour on ``side`` (1: left) from ``pose``.

        The robot backs off first if it has touched the obstacle.
        """
        self._legs = ["back", "turn", "walk"] if has_touched else ["turn", "walk"]
        self._heading = pose[2] + side * DETOUR_TURN_RAD
        self._from, self._since = pose, now

    def cancel(self) -> None:
        """Cancel the detour."""
        self._legs = []

    def step(self, pose: Pose, ahead: float, now: float) -> Action | None:
        """Return the next action; None after the detour.  ``ahead`` is the range ahead (NaN: nothing in range)."""
        while self._legs:
            action = None if now - self._since > DETOUR_LEG_TIMEOUT_S else self._leg_action(self._legs[0], pose, ahead)
            if action is not None:
                return action
            self._legs.pop(0)
            self._from, self._since = pose, now
        return None

    def _leg_action(self, leg: str, pose: Pose, ahead: float) -> Action | None:
        off = math.remainder(self._heading - pose[2], math.tau)
        walked = math.dist(pose[:2], self._from[:2])
        if leg == "back":
            return None if walked >= BACK_OFF_M else self.motion.go(-BACK_OFF_SPEED_MPS)
        if leg == "turn":
            return turn_to(self.motion, off)
        if walked >= DETOUR_LEG_M or is_blocked(ahead):
            return None
        return walk_to(self.motion, off)


def clip(value: float, limit: float) -> float:
    """Return ``value``, limited to ``limit`` in magnitude."""
    return max(-limit, min(limit, value))


def turn_to(motion: MotionCapabilities, off: float) -> Action | None:
    """Turn on the spot to a heading ``off`` radians to the left; None if the robot already has this heading."""
    return (
        None
        if abs(off) <= max(AIM_TOLERANCE_RAD, motion.facing_tolerance)
        else motion.spin(clip(TURN_GAIN * off, motion.look_turn))
    )


def walk_to(motion: MotionCapabilities, off: float) -> Action:
    """Walk towards a heading ``off`` radians to the left."""
    return motion.go(motion.walk, clip(TURN_GAIN * off, motion.look_turn))


def is_blocked(ahead: float) -> bool:
    """Return whether an obstacle is near according to ``ahead``, the range ahead (NaN: nothing in range)."""
    return not math.isnan(ahead) and ahead < CLEARANCE_M
