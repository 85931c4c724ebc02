"""DogBody: a dog of the yard as the body that an emulator moves and senses with."""

from __future__ import annotations

import math
from collections.abc import Mapping

from drivers.reading import Value
from sim.robots.camera import Camera
from sim.robots.dog import Dog, Motion
from sim.robots.sensor import Sensors
from sim.robots.world import World

BESIDE = math.radians(10.0)
"""What touches no farther than this beyond the middle presses both halves of a bumper."""


class DogBody:
    """``dog`` of ``world``, with its senses and its eye; without a gate, as a robot is that knows no tokens."""

    def __init__(self, world: World, dog: Dog, senses: Sensors, camera: Camera) -> None:
        self._world = world
        self._dog = dog
        self._senses = senses
        self._camera = camera

    def drive(self, vx: float, vy: float, wz: float) -> None:
        """Move with this velocity in its own frame until told otherwise, as fast as the kind of robot can.

        Where one of them is no number, it stands.
        """
        if not all(map(math.isfinite, (vx, vy, wz))):
            self.halt()
            return
        self._dog.drive(Motion(vx, vy, wz))

    def halt(self) -> None:
        """Stand still as fast as it can."""
        self._world.halt(self._dog.name)

    def sense(self) -> Mapping[str, Value]:
        """What the yard knows of it, and ``bump.left``, ``bump.right`` for what touches its front."""
        touches = [angle for angle in self._dog.touches if abs(angle) < math.pi / 2]
        left, right = any(angle > -BESIDE for angle in touches), any(angle < BESIDE for angle in touches)
        return {**self._senses.values(), "bump.left": left, "bump.right": right}

    def picture(self, is_halved: bool = False) -> bytes | None:
        """What it sees now as a JPEG, 208x160 or half of that each way."""
        return self._camera.jpeg(self._dog, is_halved)
