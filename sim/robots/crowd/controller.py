"""Controllers: what many robots do, each a function of what all of them sense, as arrays with a row for each."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from sim.robots.crowd.crowd import REACH, Crowd
from sim.robots.crowd.ground import Floats
from sim.robots.scene import FOOTPRINT

VIEW = math.radians(56.9) / 2
SIGHT = 3.0
"""Metres within which a robot sees the target, where nobody stands between."""
AWAY = 0.45
"""Metres from the middle at which something ahead is in the way."""
ARRIVED = 0.35
WALK, TURN = 0.16, 1.6


class Senses:
    """What the robots from number ``first`` on sense now; nothing that a robot could not know of itself."""

    def __init__(self, crowd: Crowd, first: int = 0) -> None:
        self._crowd = crowd
        self._own = slice(first, None)

    @property
    def t(self) -> float:
        """Seconds since the start."""
        return self._crowd.t

    @property
    def number(self) -> NDArray[np.int64]:
        """The number of each, by which robots that sense the same may differ."""
        return np.arange(self._crowd.ground.bodies)[self._own]

    @property
    def ranges(self) -> Floats:
        """Metres from the middle along each ray, counter-clockwise from straight ahead; ``REACH`` for nothing."""
        return self._crowd.ranges[self._own]

    def scent(self) -> tuple[Floats, Floats]:
        """How strong the target's scent is to the left and to the right ahead: 1 at it, 0 without one."""
        crowd, target = self._crowd, self._crowd.target
        x, y, heading = crowd.x[self._own], crowd.y[self._own], crowd.heading[self._own]
        if target is None:
            return np.zeros_like(x), np.zeros_like(x)
        sides = []
        for side in (math.pi / 4, -math.pi / 4):
            dx = x + FOOTPRINT * np.cos(heading + side) - target.x
            dy = y + FOOTPRINT * np.sin(heading + side) - target.y
            sides.append(1.0 / (1.0 + dx * dx + dy * dy))
        return sides[0], sides[1]

    def sight(self) -> tuple[Floats, Floats]:
        """The bearing (left positive) and the distance of the target's axis, from the middle; NaN where not in view."""
        crowd, target = self._crowd, self._crowd.target
        bearing = np.full(len(crowd.x), math.nan)
        distance = bearing.copy()
        if target is not None:
            dx, dy = target.x - crowd.x, target.y - crowd.y
            # Whoever hides the target from somebody within sight of it is nearer to it, and so within sight as well.
            near = np.flatnonzero(dx * dx + dy * dy < SIGHT * SIGHT)
            dx, dy = dx[near], dy[near]
            far, towards = np.hypot(dx, dy), np.arctan2(dy, dx)
            off = np.remainder(towards - crowd.heading[near] + math.pi, math.tau) - math.pi
            # As seen from the target: who stands before another hides it within the angle that it covers.
            apart = np.abs(np.remainder(towards[:, None] - towards + math.pi, math.tau) - math.pi)
            covers = np.arcsin(np.minimum(FOOTPRINT / far, 1.0))
            is_hidden = ((apart < covers) & (far < far[:, None])).any(axis=1)
            seers = (np.abs(off) < VIEW) & ~is_hidden
            bearing[near[seers]], distance[near[seers]] = off[seers], far[seers]
        return bearing[self._own], distance[self._own]


Controller = Callable[[Senses], Floats]
"""What each is to do now: metres a second forward and to the left, radians a second to the left."""


def stand(senses: Senses) -> Floats:
    """Nobody does anything."""
    return np.zeros((len(senses.ranges), 3))


def disperse(senses: Senses) -> Floats:
    """Walk away from whatever is near, and stand where nothing is."""
    ranges = senses.ranges
    angle = np.arange(ranges.shape[1]) * (math.tau / ranges.shape[1])
    press = 1.0 - ranges / REACH
    ahead, left = -press @ np.cos(angle), -press @ np.sin(angle)
    bearing = np.arctan2(left, ahead)
    is_pressed = np.hypot(ahead, left) > 0.05
    return _wishes(np.where(is_pressed & (np.abs(bearing) < 0.8), WALK, 0.0), np.where(is_pressed, 2.0 * bearing, 0.0))


def climb(senses: Senses) -> Floats:
    """Follow the scent of the target to where it is strongest; without one, wander."""
    left, right = senses.scent()
    both = left + right
    turn = 40.0 * (left - right) / np.maximum(both, 1e-9) * (1.0 + np.sqrt(2.0 / np.maximum(both, 1e-9)))
    wishes = wander(senses)
    is_free = (both > 0.0) & (_ahead(senses.ranges) > AWAY)
    wishes[is_free] = _wishes(np.where(np.abs(turn) < 2.0, WALK, WALK / 4), turn)[is_free]
    return wishes


def wander(senses: Senses) -> Floats:
    """Walk straight on, and turn to the more open side where something is ahead."""
    ranges = senses.ranges
    half = ranges.shape[1] // 2
    left, right = ranges[:, 1 : half + 1].sum(axis=1), ranges[:, -half:].sum(axis=1)
    # Who finds both sides alike turns as its number says, or two would dance before each other.
    side = np.where(left == right, np.where(senses.number % 2 == 0, 1.0, -1.0), np.sign(left - right))
    is_free = _ahead(ranges) > AWAY
    return _wishes(np.where(is_free, WALK, 0.0), np.where(is_free, 0.0, TURN * side))


def search(senses: Senses) -> Floats:
    """Search and approach: wander until the target is in view, walk up to it, and stand before it."""
    bearing, distance = senses.sight()
    wishes = wander(senses)
    sees = ~np.isnan(distance)
    is_aimed = sees & (np.abs(bearing) < 0.3)
    is_free = (distance < AWAY + 0.1) | (_ahead(senses.ranges) > FOOTPRINT * 2.2)
    walk = np.where(is_aimed & is_free & (distance > ARRIVED), WALK, 0.0)
    wishes[sees] = _wishes(walk, 2.2 * bearing)[sees]
    return wishes


CONTROLLERS: dict[str, Controller] = {
    "stand": stand,
    "wander": wander,
    "disperse": disperse,
    "climb": climb,
    "search": search,
}


def _ahead(ranges: Floats) -> Floats:
    """The least of the ray ahead and, shortened to the width of the robot, of the two beside it."""
    return np.minimum(ranges[:, 0], np.minimum(ranges[:, 1], ranges[:, -1]) * 1.2)


def _wishes(forward: Floats, turn: Floats) -> Floats:
    return np.stack((forward, np.zeros_like(forward), np.clip(turn, -TURN, TURN)), axis=1)
