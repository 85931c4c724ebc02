"""Pose of the robot, integrated from its wheel encoders."""

from __future__ import annotations

import math

MM_PER_COUNT = math.pi * 72.0 / 508.8
WHEEL_BASE_MM = 235.0
"""Distance between the wheels in mm."""
WHEEL_BASE_M, M_PER_COUNT = WHEEL_BASE_MM / 1000.0, MM_PER_COUNT / 1000.0
SPEED_WINDOW_S = 0.12
"""Seconds over which speeds are averaged; within one frame, a single count would mean 30 mm/s."""
MAX_WHEEL_SPEED_MPS = 0.8
"""Maximum speed of a wheel in m/s; counts that imply a higher speed are invalid."""
JUMP_TOLERANCE_M = 0.05
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
        self._recent_steps: list[tuple[float, float, float]] = []

    def discard_counts(self) -> None:
        """Keep the pose, but discard the last counts: the next counts may come from a restarted robot."""
        self._last = None
        self._recent_steps = []
        self.vx = self.wz = 0.0

    def update(self, left: int, right: int, now: float) -> None:
        """Update the pose from the encoder counts at ``now``; ignore implausible jumps."""
        before, self._last = self._last, (left, right)
        if before is None:
            self._recent_steps = [(now, 0.0, 0.0)]
            return
        left_m, right_m = (_to_signed(new - old) * M_PER_COUNT for new, old in zip((left, right), before, strict=True))
        if max(abs(left_m), abs(right_m)) > MAX_WHEEL_SPEED_MPS * (now - self._recent_steps[-1][0]) + JUMP_TOLERANCE_M:
            self.jumps += 1
            self.discard_counts()
            self.update(left, right, now)
            return
        self._move(left_m, right_m)
        self._recent_steps.append((now, left_m, right_m))
        while len(self._recent_steps) > 2 and now - self._recent_steps[1][0] >= SPEED_WINDOW_S:
            del self._recent_steps[0]
        span = now - self._recent_steps[0][0]
        if span > 0.0:
            left_v, right_v = (sum(step[wheel] for step in self._recent_steps[1:]) / span for wheel in (1, 2))
            self.vx, self.wz = (left_v + right_v) / 2.0, (right_v - left_v) / WHEEL_BASE_M

    def _move(self, left: float, right: float) -> None:
        ahead, turn = (left + right) / 2.0, (right - left) / WHEEL_BASE_M
        # The chord of the arc of the movement.
        chord = ahead if abs(turn) < 1e-9 else 2.0 * ahead / turn * math.sin(turn / 2.0)
        self.x += chord * math.cos(self.yaw + turn / 2.0)
        self.y += chord * math.sin(self.yaw + turn / 2.0)
        self.yaw = math.remainder(self.yaw + turn, math.tau)


def _to_signed(counts: int) -> int:
    return (counts + 0x8000) % 0x10000 - 0x8000
