"""CrowdBody: a robot of a crowd as the body that an emulator moves and senses with."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from drivers.reading import Value
from sim.robots.crowd.crowd import Crowd
from sim.robots.crowd.eye import Eyes
from sim.robots.crowd.feeling import Feelings
from sim.robots.emulator.dog import BESIDE
from sim.robots.scene import FOOTPRINT

TOUCHING = 0.001
"""Metres between two robots that touch, at most."""


class CrowdBody:
    """The robot ``number`` of ``crowd``; without a gate, as a robot is that knows no tokens."""

    def __init__(self, number: int, crowd: Crowd, feelings: Feelings, eyes: Eyes) -> None:
        self._number = number
        self._crowd = crowd
        self._feelings = feelings
        self._eyes = eyes

    def drive(self, vx: float, vy: float, wz: float) -> None:
        """Move with this velocity in its own frame until told otherwise, as fast as the legs can.

        Where one of them is no number, it stands.
        """
        is_motion = all(map(math.isfinite, (vx, vy, wz)))
        self._crowd.wish[self._number] = (vx, vy, wz) if is_motion else 0.0

    def halt(self) -> None:
        """Stand still as fast as it can."""
        self._crowd.wish[self._number] = 0.0

    def sense(self) -> Mapping[str, Value]:
        """What is known of it, and ``bump.left``, ``bump.right`` for what touches its front."""
        touches = [angle for angle in self._touches() if abs(angle) < math.pi / 2]
        left, right = any(angle > -BESIDE for angle in touches), any(angle < BESIDE for angle in touches)
        return {**self._feelings.values(self._number), "bump.left": left, "bump.right": right}

    def picture(self, is_halved: bool = False) -> bytes | None:
        """What it sees now as a JPEG, 208x160 or half of that each way."""
        return self._eyes.jpeg(self._number, is_halved)

    def _touches(self) -> list[float]:
        """Where something touches it: radians from straight ahead, left positive."""
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
