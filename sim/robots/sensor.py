"""Sensors of one simulated dog: rangers, accelerometer, odometry, compass, power.

Geometry and ranges are those of an ERS-7 in the stance of its stock walk: the body is 0.105 m above the floor, and the
neck is drawn back, so the nose is inside the footprint. The compass, which a real ERS-7 lacks, is mounted on the back.
"""

from __future__ import annotations

import math
from random import Random

from sim.robots.dog import Dog
from sim.robots.world import SUBSTEP_S, World

NOSE_M = 0.105
"""Distance of the rangers and the camera from the centre of the dog, in metres."""
NEAR_RANGE_M = (0.05, 0.5)
FAR_RANGE_M = (0.2, 1.5)
CHEST_RANGE_M = (0.1, 0.9)
CHEST_HEIGHT_M = 0.102
CHEST_PITCH_RAD = math.radians(30.0)
GRAVITY_MPS2 = 9.80665
BATTERY_S = 90 * 60.0
SAMPLED_KEYS = ("range.near", "range.far", "range.chest", "imu.ax", "imu.ay", "imu.az")

FLOOR_DISTANCE_M = CHEST_HEIGHT_M / math.sin(CHEST_PITCH_RAD)
CHEST_REACH_M = CHEST_HEIGHT_M / math.tan(CHEST_PITCH_RAD)


class Sensors:
    """The sensors of ``dog``; call ``sample`` once per substep, ``values`` once per sensor frame."""

    def __init__(self, rng: Random, world: World, dog: Dog) -> None:
        self._rng = rng
        self._world = world
        self._dog = dog
        self._samples: dict[str, list[float]] = {key: [] for key in SAMPLED_KEYS}
        self._newest = dict.fromkeys(SAMPLED_KEYS, math.nan)
        self._odometry = [0.0, 0.0, 0.0]
        # Each dog's stride differs slightly from the nominal length, so its odometry drifts steadily.
        self._stride_error = 1.0 + rng.gauss(0.0, 0.01)
        self._turn_error = 1.0 + rng.gauss(0.0, 0.01)
        self._power = 1.0
        # A constant compass deviation for each dog.
        self._deviation = Random(f"compass of {dog.name}").gauss(0.0, math.radians(2.0))

    def sample(self) -> None:
        """Take one sample of every sensor, 8 ms after the previous one."""
        dog, gauss = self._dog, self._rng.gauss
        moving = dog.is_moving
        ahead = self._world.distance_ahead(dog, NOSE_M, FAR_RANGE_M[1] * 1.1)
        chest = self._world.distance_ahead(dog, NOSE_M, CHEST_REACH_M)
        slant = FLOOR_DISTANCE_M if chest is None else chest / math.cos(CHEST_PITCH_RAD)
        shake = 0.25 if moving else 0.04
        for key, value in (
            ("range.near", self._read_ranger(ahead, NEAR_RANGE_M)),
            ("range.far", self._read_ranger(ahead, FAR_RANGE_M)),
            ("range.chest", self._read_ranger(slant, CHEST_RANGE_M)),
            ("imu.ax", dog.acceleration[0] + gauss(0.0, shake)),
            ("imu.ay", dog.acceleration[1] + gauss(0.0, shake)),
            ("imu.az", GRAVITY_MPS2 + gauss(0.0, shake)),
        ):
            self._samples[key].append(value)
            self._newest[key] = value
        self._update_odometry(moving)
        self._power = max(0.0, self._power - SUBSTEP_S / BATTERY_S * (1.0 if moving else 0.5))

    def values(self) -> dict[str, float | bool]:
        """Return the newest values under the keys of an observation; a range is NaN if nothing is in range."""
        vx, vy, wz = self._dog.motion
        x, y, yaw = self._odometry
        return {
            "base.vx": vx,
            "base.vy": vy,
            "base.wz": wz,
            "base.moving": self._dog.is_moving,
            "odom.x": x,
            "odom.y": y,
            "odom.yaw": math.remainder(yaw, math.tau),
            "compass.heading": math.remainder(self._dog.heading + self._deviation, math.tau),
            **self._newest,
            "power.level": self._power,
        }

    def pop_samples(self) -> dict[str, tuple[float, ...]]:
        """Return the samples since the last call, oldest first."""
        taken = {key: tuple(samples) for key, samples in self._samples.items()}
        for samples in self._samples.values():
            samples.clear()
        return taken

    def _read_ranger(self, distance: float | None, limits: tuple[float, float]) -> float:
        """Return an infrared reading, with noise that grows with distance; too near gives the minimum, too far NaN."""
        noise = self._rng.gauss(0.0, 1.0)
        if distance is None:
            return math.nan
        measured = distance + noise * (0.001 + 0.004 * distance)
        return math.nan if measured > limits[1] else max(measured, limits[0])

    def _update_odometry(self, moving: bool) -> None:
        if not moving:
            return
        vx, vy, wz = self._dog.motion
        slip = self._stride_error * (1.0 + self._rng.gauss(0.0, 0.05))
        yaw = self._odometry[2]
        self._odometry[0] += (vx * math.cos(yaw) - vy * math.sin(yaw)) * slip * SUBSTEP_S
        self._odometry[1] += (vx * math.sin(yaw) + vy * math.cos(yaw)) * slip * SUBSTEP_S
        self._odometry[2] = yaw + wz * self._turn_error * (1.0 + self._rng.gauss(0.0, 0.05)) * SUBSTEP_S
