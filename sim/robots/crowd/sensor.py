"""The sensors of the robots of a crowd that have drivers, computed with arrays.

The values have the keys of a simulated dog. Noise, drift and battery are as in ``sim.robots.sensor``, but each step
has one sample instead of four.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from random import Random

import numpy as np

from drivers.reading import Value
from sim.robots.crowd.crowd import RAY_LENGTH_M, Crowd
from sim.robots.crowd.scene import Floats
from sim.robots.sensor import (
    BATTERY_S,
    CHEST_PITCH_RAD,
    CHEST_RANGE_M,
    CHEST_REACH_M,
    FAR_RANGE_M,
    FLOOR_DISTANCE_M,
    GRAVITY_MPS2,
    NEAR_RANGE_M,
    NOSE_M,
    SAMPLED_KEYS,
)
from sim.robots.world import SUBSTEP_S, TICK_S

_KEYS = (
    *("base.vx", "base.vy", "base.wz", "odom.x", "odom.y", "odom.yaw", "compass.heading"),
    *SAMPLED_KEYS,
    "power.level",
)
_STEADY = 0.05 * math.sqrt(SUBSTEP_S / TICK_S)
"""Standard deviation of a stride, reduced because one step here replaces four substeps."""


class CrowdSensors:
    """Sensor values of the first robots of ``crowd``, named ``names``; call ``sample`` once per step."""

    def __init__(self, seed: int, crowd: Crowd, names: Sequence[str]) -> None:
        self._crowd = crowd
        self._rng = np.random.default_rng(seed)
        count = len(names)
        self._odometry = np.zeros((3, count))
        self._stride_error, self._turn_error = 1.0 + self._rng.normal(0.0, 0.01, (2, count))
        self._power = np.ones(count)
        self._deviation = np.array([Random(f"compass of {name}").gauss(0.0, math.radians(2.0)) for name in names])
        self._rows: list[list[float]] = [[math.nan] * len(_KEYS)] * count
        self._moving: list[bool] = [False] * count

    def sample(self) -> None:
        """Take a sample, ``TICK_S`` seconds after the previous one."""
        crowd, first = self._crowd, slice(0, len(self._power))
        heading, wz = crowd.heading[first], crowd.wz[first]
        cos, sin = np.cos(heading), np.sin(heading)
        vx = cos * crowd.vx[first] + sin * crowd.vy[first]
        vy = cos * crowd.vy[first] - sin * crowd.vx[first]
        moving = (crowd.commands[first] != 0.0).any(axis=1) | (np.hypot(vx, vy) > 0.005) | (np.abs(wz) > 0.02)
        noise = self._rng.normal(size=(8, len(vx)))
        self._update_odometry(moving, vx, vy, wz, noise[:2])
        self._power = np.maximum(0.0, self._power - TICK_S / BATTERY_S * np.where(moving, 1.0, 0.5))
        ahead = crowd.ranges[first, 0]
        ahead = np.where(ahead < RAY_LENGTH_M, ahead - NOSE_M, math.nan)
        slant = np.where(ahead < CHEST_REACH_M, ahead / math.cos(CHEST_PITCH_RAD), FLOOR_DISTANCE_M)
        shake = np.where(moving, 0.25, 0.04)
        x, y, yaw = self._odometry
        columns = (
            *(vx, vy, wz, x, y, _normalize_angle(yaw), _normalize_angle(heading + self._deviation)),
            *(
                _read_ranger(gap, limits, n)
                for gap, limits, n in ((ahead, NEAR_RANGE_M, noise[2]), (ahead, FAR_RANGE_M, noise[3]))
            ),
            _read_ranger(slant, CHEST_RANGE_M, noise[4]),
            cos * crowd.ax[first] + sin * crowd.ay[first] + shake * noise[5],
            cos * crowd.ay[first] - sin * crowd.ax[first] + shake * noise[6],
            GRAVITY_MPS2 + shake * noise[7],
            self._power,
        )
        self._rows = np.stack(columns, axis=1).tolist()
        self._moving = moving.tolist()

    def values(self, number: int) -> dict[str, Value]:
        """Return the newest values of the robot ``number``; a range is NaN if nothing is in range."""
        return {**dict(zip(_KEYS, self._rows[number], strict=True)), "base.moving": self._moving[number]}

    def _update_odometry(self, moving: Floats, vx: Floats, vy: Floats, wz: Floats, noise: Floats) -> None:
        x, y, yaw = self._odometry
        slip = self._stride_error * (1.0 + _STEADY * noise[0]) * moving * TICK_S
        cos, sin = np.cos(yaw), np.sin(yaw)
        x += (vx * cos - vy * sin) * slip
        y += (vx * sin + vy * cos) * slip
        yaw += wz * self._turn_error * (1.0 + _STEADY * noise[1]) * moving * TICK_S


def to_samples(values: dict[str, Value]) -> dict[str, tuple[float, ...]]:
    """Return the samples of one frame: one of each sensor."""
    return {key: (float(values[key]),) for key in SAMPLED_KEYS}


def _normalize_angle(angle: Floats) -> Floats:
    normalized: Floats = np.remainder(angle + math.pi, math.tau) - math.pi
    return normalized


def _read_ranger(gap: Floats, limits: tuple[float, float], noise: Floats) -> Floats:
    """Return infrared readings, with noise that grows with distance; too near gives the minimum, too far NaN."""
    measured = gap + noise * (0.001 + 0.004 * gap)
    return np.where(measured > limits[1], math.nan, np.maximum(measured, limits[0]))
