"""A crowd in which the first robots have drivers, over the simulator's protocol, and a controller moves the others."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import partial
from random import Random

import numpy as np
from twisted.internet.interfaces import IReactorTime

from drivers.reading import Value
from sim.robots.crowd.camera import CrowdCameras
from sim.robots.crowd.controller import Controller, Readings, wander
from sim.robots.crowd.crowd import Crowd
from sim.robots.crowd.scene import CrowdScene
from sim.robots.crowd.sensor import CrowdSensors, to_samples
from sim.robots.emulator.dog import BUMPER_OVERLAP_RAD
from sim.robots.paced_simulator import PacedSimulator
from sim.robots.scene import FOOTPRINT_RADIUS_M, SceneError

SPARE_CONNECTIONS = 8
"""Number of connections in addition to one per robot with a driver."""
CONTACT_GAP_M = 0.001
"""Largest gap in metres between two robots in contact."""


class CrowdSimulator(PacedSimulator):
    """A simulator of many robots, on ``scene``.

    The first ``driven`` robots (``robot1`` and so on) obey their drivers; such a robot stands still if it has no
    driver. ``controller`` moves all other robots. ``stopwatch`` measures the time spent on moving the robots
    (``moving_s``) and on sending sensor values to the drivers (``reporting_s``).
    """

    def __init__(
        self,
        clock: IReactorTime,
        rng: Random,
        scene: CrowdScene,
        driven: int = 0,
        controller: Controller = wander,
        stopwatch: Callable[[], float] = lambda: 0.0,
    ) -> None:
        if type(driven) is not int or not 0 <= driven <= scene.robots:
            raise SceneError(
                f"driven must be a whole number from 0 to {scene.robots}, the number of robots, not {driven!r}"
            )
        self.crowd = Crowd(rng.getrandbits(64), scene)
        self.names = [f"robot{number}" for number in range(1, driven + 1)]
        self.moving_s = self.reporting_s = 0.0
        self._controller = controller
        self._other_readings = Readings(self.crowd, driven)
        self._sensors = CrowdSensors(rng.getrandbits(64), self.crowd, self.names)
        self._cameras = CrowdCameras(Random(rng.getrandbits(64)), self.crowd)
        self._numbers = {name: number for number, name in enumerate(self.names)}
        self._stopwatch = stopwatch
        super().__init__(clock, self.names, self, driven + SPARE_CONNECTIONS)

    def reserve_for_emulator(self, name: str) -> CrowdRobot:
        """Reserve a robot for an emulator, so that drivers can no longer use the robot.

        Raises ``UsageError`` if no such robot can have a driver.
        """
        self._reserve_robot(name)
        return CrowdRobot(self._numbers[name], self.crowd, self._sensors, self._cameras)

    def drive(self, name: str, vx: float, vy: float, wz: float) -> None:
        """Set the robot's velocity in its frame, until the next command."""
        self.crowd.commands[self._numbers[name]] = (vx, vy, wz)

    def halt(self, name: str) -> None:
        """Stop the robot, braking as hard as it can."""
        self.crowd.commands[self._numbers[name]] = 0.0

    def _simulate(self, late: float) -> int:
        """Simulate one tick, even if several are due: the next one follows immediately, with newer commands."""
        started_at = self._stopwatch()
        self._stop_expired(self.crowd.t)
        self.crowd.commands[len(self.names) :] = self._controller(self._other_readings)
        self.crowd.step()
        self._sensors.sample()
        moved = self._stopwatch()
        for number, name in enumerate(self.names):
            if name in self._drivers:
                values = self._sensors.values(number)
                self._report_sensors(
                    name, self.crowd.t, values, to_samples(values), partial(self._cameras.render_jpeg, number)
                )
        self._drop_silent()
        self.moving_s += moved - started_at
        self.reporting_s += self._stopwatch() - moved
        return 1


class CrowdRobot:
    """The robot ``number`` of ``crowd``; it has no gate, like a robot whose protocol has no tokens."""

    def __init__(self, number: int, crowd: Crowd, sensors: CrowdSensors, cameras: CrowdCameras) -> None:
        self._number = number
        self._crowd = crowd
        self._sensors = sensors
        self._cameras = cameras

    def drive(self, vx: float, vy: float, wz: float) -> None:
        """Set the velocity in the robot's frame, until the next command.

        The robot stands still if a value is not finite.
        """
        is_motion = all(map(math.isfinite, (vx, vy, wz)))
        self._crowd.commands[self._number] = (vx, vy, wz) if is_motion else 0.0

    def halt(self) -> None:
        """Stop, braking as hard as it can."""
        self._crowd.commands[self._number] = 0.0

    def sense(self) -> Mapping[str, Value]:
        """Return the sensor values, with ``bump.left`` and ``bump.right`` for contacts at the front."""
        touches = [angle for angle in self._find_contacts() if abs(angle) < math.pi / 2]
        left, right = (
            any(angle > -BUMPER_OVERLAP_RAD for angle in touches),
            any(angle < BUMPER_OVERLAP_RAD for angle in touches),
        )
        return {**self._sensors.values(self._number), "bump.left": left, "bump.right": right}

    def picture(self, is_halved: bool = False) -> bytes | None:
        """Return the camera picture as a JPEG, 208x160 pixels, or 104x80 if ``is_halved``."""
        return self._cameras.render_jpeg(self._number, is_halved)

    def _find_contacts(self) -> list[float]:
        """Return the directions of contacts: radians from straight ahead, left positive."""
        crowd, number = self._crowd, self._number
        x, y, heading = (float(row[number]) for row in (crowd.x, crowd.y, crowd.heading))
        dx, dy = crowd.x - x, crowd.y - y
        is_near = np.hypot(dx, dy) < 2 * FOOTPRINT_RADIUS_M + CONTACT_GAP_M
        is_near[number] = False
        found = np.arctan2(dy[is_near], dx[is_near]).tolist()
        width, height, least = crowd.scene.width, crowd.scene.height, FOOTPRINT_RADIUS_M + CONTACT_GAP_M
        walls = ((width - x, 0.0), (height - y, math.pi / 2), (x, math.pi), (y, -math.pi / 2))
        found += [angle for gap, angle in walls if gap < least]
        target = crowd.target
        if target is not None and math.hypot(target.x - x, target.y - y) < least + target.radius:
            found.append(math.atan2(target.y - y, target.x - x))
        return [math.remainder(angle - heading, math.tau) for angle in found]
