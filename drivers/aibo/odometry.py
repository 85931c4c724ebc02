"""Odometry: where the dog should be by what it was told; its legs measure nothing; pure."""

from __future__ import annotations

import math

from drivers.reading import Value

WRAP_MS = 2**32
LONGEST_MS = 1000
"""After a longer gap nobody knows what the dog did in it."""


class Odometry:
    """Counts the robot's time on, past its wrap, and adds up the commanded velocity over it."""

    def __init__(self) -> None:
        self.t = 0.0
        self._place = [0.0, 0.0, 0.0]
        self._newest: int | None = None

    def forget(self) -> None:
        """The link was lost: the next time stamp follows on none."""
        self._newest = None

    def moment(self, t_ms: int) -> float:
        """A time stamp near the newest one as seconds of ``t``."""
        if self._newest is None:
            return self.t
        return self.t + ((t_ms - self._newest + WRAP_MS // 2) % WRAP_MS - WRAP_MS // 2) / 1000.0

    def step(self, t_ms: int, vx: float, vy: float, wz: float) -> None:
        """So the dog moved until ``t_ms``."""
        gone = 0 if self._newest is None else (t_ms - self._newest) % WRAP_MS
        if self._newest is None and self.t == 0.0:
            self.t = t_ms / 1000.0
        self._newest = t_ms
        if gone > LONGEST_MS:
            return
        dt = gone / 1000.0
        self.t += dt
        x, y, yaw = self._place
        cos, sin = math.cos(yaw), math.sin(yaw)
        self._place = [x + (vx * cos - vy * sin) * dt, y + (vx * sin + vy * cos) * dt, yaw + wz * dt]

    def values(self) -> dict[str, Value]:
        """The place under the keys of an observation."""
        x, y, yaw = self._place
        return {"odom.x": x, "odom.y": y, "odom.yaw": math.remainder(yaw, math.tau)}
