"""Pose of the robot, integrated from its wheel encoders."""

from __future__ import annotations

import math

MM_PER_COUNT = math.pi * 72.0 / 508.8
WHEEL_BASE = 235.0
"""Distance between the wheels in mm."""
BASE_M, STEP_M = WHEEL_BASE / 1000.0, MM_PER_COUNT / 1000.0
WINDOW_S = 0.12
"""Window of the mean speeds in seconds; one count within one frame would be 30 mm/s."""
TOP = 0.8
"""Top speed of a wheel in m/s; larger changes of the counts are invalid."""
SLACK = 0.05
"""Tolerance in metres for frames that arrive late and together."""


class Odometry:
    """Pose and speed from the counts of both wheels, which wrap at 65536.

    Lengths are in metres, angles in radians, counter-clockwise; the initial pose is 0.
    """

    def __init__(self) -> None:
        self.x = self.y = self.yaw = 0.0
        self.vx = self.wz = 0.0
        self.jumps = 0
        self._last: tuple[int, int] | None = None
        self._trail: list[tuple[float, float, float]] = []

    def forget(self) -> None:
        """Keep the pose and discard the counts: the next ones may come from a restarted robot."""
        self._last = None
        self._trail = []
        self.vx = self.wz = 0.0

    def count(self, left: int, right: int, now: float) -> None:
        """Take the wheels' counts at ``now``; implausible jumps do not move the pose."""
        before, self._last = self._last, (left, right)
        if before is None:
            self._trail = [(now, 0.0, 0.0)]
            return
        left_m, right_m = (_signed(new - old) * STEP_M for new, old in zip((left, right), before, strict=True))
        if max(abs(left_m), abs(right_m)) > TOP * (now - self._trail[-1][0]) + SLACK:
            self.jumps += 1
            self.forget()
            self.count(left, right, now)
            return
        self._move(left_m, right_m)
        self._trail.append((now, left_m, right_m))
        while len(self._trail) > 2 and now - self._trail[1][0] >= WINDOW_S:
            del self._trail[0]
        span = now - self._trail[0][0]
        if span > 0.0:
            left_v, right_v = (sum(step[wheel] for step in self._trail[1:]) / span for wheel in (1, 2))
            self.vx, self.wz = (left_v + right_v) / 2.0, (right_v - left_v) / BASE_M

    def _move(self, left: float, right: float) -> None:
        ahead, turn = (left + right) / 2.0, (right - left) / BASE_M
        # The chord of the arc of the movement.
        chord = ahead if abs(turn) < 1e-9 else 2.0 * ahead / turn * math.sin(turn / 2.0)
        self.x += chord * math.cos(self.yaw + turn / 2.0)
        self.y += chord * math.sin(self.yaw + turn / 2.0)
        self.yaw = math.remainder(self.yaw + turn, math.tau)


def _signed(counts: int) -> int:
    return (counts + 0x8000) % 0x10000 - 0x8000
