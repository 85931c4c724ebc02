"""A simulated dog behind the interface that emulators use."""

from __future__ import annotations

import math
from collections.abc import Mapping

from drivers.reading import Value
from sim.robots.camera import Camera
from sim.robots.dog import Dog, Motion
from sim.robots.sensor import Sensors
from sim.robots.world import World

BUMPER_OVERLAP_RAD = math.radians(10.0)
"""Angle in radians on either side of the centre within which a contact presses both halves of a bumper."""


class SimulatedDog:
    """``dog`` of ``world``, with its sensors and its camera; it has no gate, like a robot without tokens."""

    def __init__(self, world: World, dog: Dog, senses: Sensors, camera: Camera) -> None:
        self._world = world
        self._dog = dog
        self._sensors = senses
        self._camera = camera

    def drive(self, vx: float, vy: float, wz: float) -> None:
        """Set the velocity in the dog's frame, until the next command, within the limits of the robot's kind.

        The dog stands still if a value is not finite.
        """
        if not all(map(math.isfinite, (vx, vy, wz))):
            self.halt()
            return
        self._dog.drive(Motion(vx, vy, wz))

    def halt(self) -> None:
        """Stop, braking as hard as it can."""
        self._world.halt(self._dog.name)

    def sense(self) -> Mapping[str, Value]:
        """Return the sensor values, with ``bump.left`` and ``bump.right`` for contacts at the front."""
        touches = [angle for angle in self._dog.contact_directions if abs(angle) < math.pi / 2]
        left, right = (
            any(angle > -BUMPER_OVERLAP_RAD for angle in touches),
            any(angle < BUMPER_OVERLAP_RAD for angle in touches),
        )
        return {**self._sensors.values(), "bump.left": left, "bump.right": right}

    def picture(self, is_halved: bool = False) -> bytes | None:
        """Return the camera picture as a JPEG, 208x160 pixels, or 104x80 if ``is_halved``."""
        return self._camera.render_jpeg(self._dog, is_halved)
