"""Batch controllers: functions from the sensor values of all robots to their velocities, as arrays.

Each array has one row per robot.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from sim.robots.crowd.crowd import RAY_LENGTH_M, Crowd
from sim.robots.crowd.scene import Floats
from sim.robots.scene import FOOTPRINT_RADIUS_M

HALF_VIEW_RAD = math.radians(56.9) / 2
SIGHT_M = 3.0
"""Distance in metres up to which a robot sees the target, unless another robot hides the target."""
OBSTACLE_DISTANCE_M = 0.45
"""Distance in metres from the robot's centre within which something ahead is an obstacle."""
ARRIVAL_DISTANCE_M = 0.35
WALK_MPS, TURN_RADPS = 0.16, 1.6


class Readings:
    """Sensor values of the robots from number ``first`` on: only values that a robot could measure itself."""

    def __init__(self, crowd: Crowd, first: int = 0) -> None:
        self._crowd = crowd
        self._own = slice(first, None)

    @property
    def t(self) -> float:
        """Seconds since the start."""
        return self._crowd.t

    @property
    def number(self) -> NDArray[np.int64]:
        """The number of each robot, so that robots with equal sensor values can act differently."""
        return np.arange(self._crowd.scene.robots)[self._own]

    @property
    def ranges(self) -> Floats:
        """Metres from the centre along each ray, counter-clockwise from ahead; ``RAY_LENGTH_M`` if nothing is hit."""
        return self._crowd.ranges[self._own]

    def read_scent(self) -> tuple[Floats, Floats]:
        """Return the strength of the target's scent ahead on the left and the right: 1 at the target, 0 without it."""
        crowd, target = self._crowd, self._crowd.target
        x, y, heading = crowd.x[self._own], crowd.y[self._own], crowd.heading[self._own]
        if target is None:
            return np.zeros_like(x), np.zeros_like(x)
        sides = []
        for side in (math.pi / 4, -math.pi / 4):
            dx = x + FOOTPRINT_RADIUS_M * np.cos(heading + side) - target.x
            dy = y + FOOTPRINT_RADIUS_M * np.sin(heading + side) - target.y
            sides.append(1.0 / (1.0 + dx * dx + dy * dy))
        return sides[0], sides[1]

    def read_target(self) -> tuple[Floats, Floats]:
        """Return bearing (left positive) and distance of the target's axis from the centre; NaN if not in view."""
        crowd, target = self._crowd, self._crowd.target
        bearing = np.full(len(crowd.x), math.nan)
        distance = bearing.copy()
        if target is not None:
            dx, dy = target.x - crowd.x, target.y - crowd.y
            # A robot that hides the target from a robot in this set is nearer to the target, so the hiding robot is
            # also in this set.
            near = np.flatnonzero(dx * dx + dy * dy < SIGHT_M * SIGHT_M)
            dx, dy = dx[near], dy[near]
            far, towards = np.hypot(dx, dy), np.arctan2(dy, dx)
            off = np.remainder(towards - crowd.heading[near] + math.pi, math.tau) - math.pi
            # As seen from the target, a nearer robot hides all robots behind it within the angle that it covers.
            apart = np.abs(np.remainder(towards[:, None] - towards + math.pi, math.tau) - math.pi)
            covers = np.arcsin(np.minimum(FOOTPRINT_RADIUS_M / far, 1.0))
            is_hidden = ((apart < covers) & (far < far[:, None])).any(axis=1)
            observers = (np.abs(off) < HALF_VIEW_RAD) & ~is_hidden
            bearing[near[observers]], distance[near[observers]] = off[observers], far[observers]
        return bearing[self._own], distance[self._own]


Controller = Callable[[Readings], Floats]
"""Returns the velocity of each robot: m/s forward and to the left, rad/s to the left."""


def stand(senses: Readings) -> Floats:
    """Stand still."""
    return np.zeros((len(senses.ranges), 3))


def disperse(senses: Readings) -> Floats:
    """Move away from all near objects; stand if nothing is near."""
    ranges = senses.ranges
    angle = np.arange(ranges.shape[1]) * (math.tau / ranges.shape[1])
    press = 1.0 - ranges / RAY_LENGTH_M
    ahead, left = -press @ np.cos(angle), -press @ np.sin(angle)
    bearing = np.arctan2(left, ahead)
    is_pressed = np.hypot(ahead, left) > 0.05
    return _make_velocities(
        np.where(is_pressed & (np.abs(bearing) < 0.8), WALK_MPS, 0.0), np.where(is_pressed, 2.0 * bearing, 0.0)
    )


def climb(senses: Readings) -> Floats:
    """Follow the scent of the target to its maximum; without a scent, wander."""
    left, right = senses.read_scent()
    both = left + right
    turn = 40.0 * (left - right) / np.maximum(both, 1e-9) * (1.0 + np.sqrt(2.0 / np.maximum(both, 1e-9)))
    velocities = wander(senses)
    is_free = (both > 0.0) & (_find_nearest_ahead(senses.ranges) > OBSTACLE_DISTANCE_M)
    velocities[is_free] = _make_velocities(np.where(np.abs(turn) < 2.0, WALK_MPS, WALK_MPS / 4), turn)[is_free]
    return velocities


def wander(senses: Readings) -> Floats:
    """Drive straight, and turn to the more open side if something is ahead."""
    ranges = senses.ranges
    half = ranges.shape[1] // 2
    left, right = ranges[:, 1 : half + 1].sum(axis=1), ranges[:, -half:].sum(axis=1)
    # If both sides are equally open, the robot's number decides; otherwise two robots could mirror each other forever.
    side = np.where(left == right, np.where(senses.number % 2 == 0, 1.0, -1.0), np.sign(left - right))
    is_free = _find_nearest_ahead(ranges) > OBSTACLE_DISTANCE_M
    return _make_velocities(np.where(is_free, WALK_MPS, 0.0), np.where(is_free, 0.0, TURN_RADPS * side))


def search(senses: Readings) -> Floats:
    """Wander until the target is in view, approach it, and stop in front of it."""
    bearing, distance = senses.read_target()
    velocities = wander(senses)
    has_target = ~np.isnan(distance)
    is_aimed = has_target & (np.abs(bearing) < 0.3)
    is_free = (distance < OBSTACLE_DISTANCE_M + 0.1) | (_find_nearest_ahead(senses.ranges) > FOOTPRINT_RADIUS_M * 2.2)
    walk = np.where(is_aimed & is_free & (distance > ARRIVAL_DISTANCE_M), WALK_MPS, 0.0)
    velocities[has_target] = _make_velocities(walk, 2.2 * bearing)[has_target]
    return velocities


CONTROLLERS: dict[str, Controller] = {
    "stand": stand,
    "wander": wander,
    "disperse": disperse,
    "climb": climb,
    "search": search,
}


def _find_nearest_ahead(ranges: Floats) -> Floats:
    """Return the smallest range of the ray ahead and its two neighbours, which count only within the robot's width."""
    return np.minimum(ranges[:, 0], np.minimum(ranges[:, 1], ranges[:, -1]) * 1.2)


def _make_velocities(forward: Floats, turn: Floats) -> Floats:
    return np.stack((forward, np.zeros_like(forward), np.clip(turn, -TURN_RADPS, TURN_RADPS)), axis=1)
