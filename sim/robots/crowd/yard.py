"""A crowd in which the first robots have drivers, over the simulator's protocol, and a controller moves the others."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import partial
from random import Random

import numpy as np
from twisted.internet.interfaces import IReactorTime

from drivers.reading import Value
from sim.robots.crowd.controller import Controller, Senses, wander
from sim.robots.crowd.crowd import Crowd
from sim.robots.crowd.eye import Eyes
from sim.robots.crowd.feeling import Feelings, sampled
from sim.robots.crowd.ground import Ground
from sim.robots.emulator.dog import BESIDE
from sim.robots.reception import PacedYard
from sim.robots.scene import FOOTPRINT, SceneError

SPARE = 8
"""Number of connections in addition to one per robot with a driver."""
TOUCHING = 0.001
"""Largest gap in metres between two robots in contact."""


class CrowdYard(PacedYard):
    """A simulator of many robots, on ``ground``.

    The first ``driven`` robots, ``robot1`` and so on, obey drivers and stand still without one; ``controller`` moves
    the others.  ``stopwatch`` measures the time spent in ``moving`` robots and in ``telling`` drivers the sensor
    values.
    """

    def __init__(
        self,
        clock: IReactorTime,
        rng: Random,
        ground: Ground,
        driven: int = 0,
        controller: Controller = wander,
        stopwatch: Callable[[], float] = lambda: 0.0,
    ) -> None:
        if type(driven) is not int or not 0 <= driven <= ground.bodies:
            raise SceneError(
                f"driven must be a whole number from 0 to {ground.bodies}, the robots here, not {driven!r}"
            )
        self.crowd = Crowd(rng.getrandbits(64), ground)
        self.names = [f"robot{number}" for number in range(1, driven + 1)]
        self.moving = self.telling = 0.0
        self._controller = controller
        self._others = Senses(self.crowd, driven)
        self._feelings = Feelings(rng.getrandbits(64), self.crowd, self.names)
        self._eyes = Eyes(Random(rng.getrandbits(64)), self.crowd)
        self._numbers = {name: number for number, name in enumerate(self.names)}
        self._stopwatch = stopwatch
        super().__init__(clock, self.names, self, driven + SPARE)

    def lend(self, name: str) -> CrowdBody:
        """Transfer a robot to an emulator; drivers can no longer hold it.

        Raises ``UsageError`` if no such robot can have a driver.
        """
        self._reserve_robot(name)
        return CrowdBody(self._numbers[name], self.crowd, self._feelings, self._eyes)

    def drive(self, name: str, vx: float, vy: float, wz: float) -> None:
        """Set the robot's velocity in its frame, until the next command."""
        self.crowd.wish[self._numbers[name]] = (vx, vy, wz)

    def halt(self, name: str) -> None:
        """Stop the robot, braking as hard as it can."""
        self.crowd.wish[self._numbers[name]] = 0.0

    def _simulate(self, late: float) -> int:
        """Simulate one tick, even if several are late: the next one follows at once, with newly received commands."""
        started_at = self._stopwatch()
        self._expire(self.crowd.t)
        self.crowd.wish[len(self.names) :] = self._controller(self._others)
        self.crowd.step()
        self._feelings.sample()
        moved = self._stopwatch()
        for number, name in enumerate(self.names):
            if name in self._drivers:
                values = self._feelings.values(number)
                self._report_sensors(name, self.crowd.t, values, sampled(values), partial(self._eyes.jpeg, number))
        self._drop_silent()
        self.moving += moved - started_at
        self.telling += self._stopwatch() - moved
        return 1


class CrowdBody:
    """The robot ``number`` of ``crowd``; without a gate, like a robot that does not know tokens."""

    def __init__(self, number: int, crowd: Crowd, feelings: Feelings, eyes: Eyes) -> None:
        self._number = number
        self._crowd = crowd
        self._feelings = feelings
        self._eyes = eyes

    def drive(self, vx: float, vy: float, wz: float) -> None:
        """Set the velocity in the robot's frame, until the next command.

        The robot stands still if a value is not finite.
        """
        is_motion = all(map(math.isfinite, (vx, vy, wz)))
        self._crowd.wish[self._number] = (vx, vy, wz) if is_motion else 0.0

    def halt(self) -> None:
        """Stop, braking as hard as it can."""
        self._crowd.wish[self._number] = 0.0

    def sense(self) -> Mapping[str, Value]:
        """Return the sensor values, with ``bump.left`` and ``bump.right`` for contacts at the front."""
        touches = [angle for angle in self._touches() if abs(angle) < math.pi / 2]
        left, right = any(angle > -BESIDE for angle in touches), any(angle < BESIDE for angle in touches)
        return {**self._feelings.values(self._number), "bump.left": left, "bump.right": right}

    def picture(self, is_halved: bool = False) -> bytes | None:
        """Return the camera picture as a JPEG, 208x160 pixels, or 104x80 if ``is_halved``."""
        return self._eyes.jpeg(self._number, is_halved)

    def _touches(self) -> list[float]:
        """Return the directions of contacts: radians from straight ahead, left positive."""
        crowd, number = self._crowd, self._number
        x, y, heading = (float(row[number]) for row in (crowd.x, crowd.y, crowd.heading))
        dx, dy = crowd.x - x, crowd.y - y
        is_near = np.hypot(dx, dy) < 2 * FOOTPRINT + TOUCHING
        is_near[number] = False
        found = np.arctan2(dy[is_near], dx[is_near]).tolist()
        width, height, least = crowd.ground.width, crowd.ground.height, FOOTPRINT + TOUCHING
        walls = ((width - x, 0.0), (height - y, math.pi / 2), (x, math.pi), (y, -math.pi / 2))
        found += [angle for gap, angle in walls if gap < least]
        target = crowd.target
        if target is not None and math.hypot(target.x - x, target.y - y) < least + target.radius:
            found.append(math.atan2(target.y - y, target.x - x))
        return [math.remainder(angle - heading, math.tau) for angle in found]
