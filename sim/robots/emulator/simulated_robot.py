"""The interface through which emulators move and sense, for simulated dogs, and ``MemoryRobot`` for tests."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol

from drivers.reading import Value


class SimulatedRobot(Protocol):
    """One simulated robot in SI units; x forward, y left, counter-clockwise positive."""

    def drive(self, vx: float, vy: float, wz: float) -> None:
        """Set the velocity in the robot's frame (m/s, m/s, rad/s), until the next command."""

    def halt(self) -> None:
        """Stop, braking as hard as it can."""

    def sense(self) -> Mapping[str, Value]:
        """Return current values under the keys of an observation: ``odom.x``, ``range.near``, ``power.level`` ..."""

    def picture(self, is_halved: bool = False) -> bytes | None:
        """Return the camera picture as a JPEG, optionally at half the width and height; None without a camera."""


@dataclass
class MemoryRobot:
    """A simulated robot on an endless floor; ``advance`` moves it exactly as commanded."""

    x: float = 0.0
    y: float = 0.0
    yaw: float = 0.0
    motion: tuple[float, float, float] = (0.0, 0.0, 0.0)
    values: dict[str, Value] = field(default_factory=lambda: {"power.level": 1.0})
    jpeg: bytes | None = None

    def drive(self, vx: float, vy: float, wz: float) -> None:
        """Set the velocity."""
        self.motion = (vx, vy, wz)

    def halt(self) -> None:
        """Stand still."""
        self.motion = (0.0, 0.0, 0.0)

    def sense(self) -> Mapping[str, Value]:
        """Return its pose, its velocity, and ``values``."""
        vx, vy, wz = self.motion
        moving = any(self.motion)
        pose: dict[str, Value] = {"odom.x": self.x, "odom.y": self.y, "odom.yaw": self.yaw, "base.moving": moving}
        return {**pose, "base.vx": vx, "base.vy": vy, "base.wz": wz, **self.values}

    def picture(self, is_halved: bool = False) -> bytes | None:
        """Return ``jpeg``, for any size."""
        return self.jpeg

    def advance(self, seconds: float) -> None:
        """Simulate ``seconds`` in one step along a straight line."""
        vx, vy, wz = self.motion
        cos, sin = math.cos(self.yaw), math.sin(self.yaw)
        self.x += (vx * cos - vy * sin) * seconds
        self.y += (vx * sin + vy * cos) * seconds
        self.yaw = math.remainder(self.yaw + wz * seconds, math.tau)
