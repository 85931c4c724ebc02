"""Many round robots in a walled world, computed with arrays in steps of 32 ms; deterministic for a given seed.

The robots have the size, the speeds and the acceleration of the simulated dogs (``sim.robots.dog``).  Contact is
geometric: overlapping robots are pushed apart, and their velocities follow from their positions.  Metres, radians,
seconds; x to the right, y up.
"""

from __future__ import annotations

import hashlib
import math
import struct

import numpy as np

from sim.robots.crowd.ray import Disc, Neighbours, Rays
from sim.robots.crowd.scene import CrowdScene, Floats
from sim.robots.dog import ACCELERATION_MPS2, ANGULAR_ACCELERATION_RADPS2, BRAKING_MPS2, LIMITS
from sim.robots.scene import FOOTPRINT_RADIUS_M
from sim.robots.world import TICK_S, NotPossible, Target

RAYS = 8
RAY_LENGTH_M = 1.7
"""Length in metres of a ray from a robot's centre; slightly more than the range of the far ranger, at the front."""
MAX_PUSHES = 12
"""Maximum iterations of pushing overlapping robots apart in one step; only dense crowds need more than one."""
CORRECTED_SHARE = 0.9
"""Fraction of an overlap that an iteration removes; in a dense crowd robots are pushed from all sides."""
SLOP_M = 0.0001
"""Overlap in metres that is not corrected."""
CLOSE_M = 2 * FOOTPRINT_RADIUS_M + 0.03
"""Distance in metres between the centres of two robots that may overlap within one step."""
SKIN_M = 0.1
_SPANS = [LIMITS[key] for key in ("base.vx", "base.vy", "base.wz")]


class Crowd:
    """The robots of ``scene``, numbered from 0; ``seed`` determines their initial positions.

    ``x y heading`` are their poses, ``vx vy wz`` their velocities in the world's frame, ``ax ay`` their accelerations
    in the last step, ``commands`` their commanded velocities (forward, left, turn), ``ranges`` the length of each ray.
    """

    def __init__(self, seed: int, scene: CrowdScene) -> None:
        self.scene = scene
        self.target: Target | None = None
        self.ticks = 0
        self._rng = np.random.default_rng(seed)
        self.x, self.y, self.heading = scene.draw_poses(self._rng)
        count = scene.robots
        self.vx, self.vy, self.wz = np.zeros(count), np.zeros(count), np.zeros(count)
        self.ax, self.ay = np.zeros(count), np.zeros(count)
        self.commands = np.zeros((count, 3))
        self._rays = Rays(scene.width, scene.height, RAYS, RAY_LENGTH_M)
        self._neighbours = Neighbours(CLOSE_M, SKIN_M)
        self.ranges = self.cast_rays()

    @property
    def t(self) -> float:
        """Simulated time in seconds since the start."""
        return self.ticks * TICK_S

    def step(self) -> None:
        """Simulate ``TICK_S`` seconds."""
        before_x, before_y, before_vx, before_vy = self.x, self.y, self.vx, self.vy
        self._accelerate()
        self.x, self.y = self.x + self.vx * TICK_S, self.y + self.vy * TICK_S
        self.heading = np.remainder(self.heading + self.wz * TICK_S + math.pi, math.tau) - math.pi
        self._resolve_overlaps()
        self.vx, self.vy = (self.x - before_x) / TICK_S, (self.y - before_y) / TICK_S
        self.ax, self.ay = (self.vx - before_vx) / TICK_S, (self.vy - before_vy) / TICK_S
        self.ranges = self.cast_rays()
        self.ticks += 1

    def cast_rays(self) -> Floats:
        """Return the length of each ray of each robot."""
        target = self.target
        discs: list[Disc] = [] if target is None else [(target.x, target.y, target.radius)]
        return self._rays.cast(self.x, self.y, self.heading, discs)

    def place_target(self, x: float, y: float) -> None:
        """Move the target to this position; raise ``NotPossible`` if a robot or a wall is in the way."""
        scene = self.scene
        radius = scene.target_radius
        if not (radius <= x <= scene.width - radius and radius <= y <= scene.height - radius):
            raise NotPossible(
                f"the target does not fit at ({x:.2f}, {y:.2f}); x must be {radius:g} to {scene.width - radius:g}, "
                f"y {radius:g} to {scene.height - radius:g}"
            )
        gap = np.hypot(self.x - x, self.y - y)
        if gap.min() < FOOTPRINT_RADIUS_M + radius:
            raise NotPossible(f"robot {int(gap.argmin())} stands at ({x:.2f}, {y:.2f}); choose a free place")
        self.target = Target(x, y, radius, scene.target_height)
        self.ranges = self.cast_rays()

    def place_target_at_random(self) -> None:
        """Move the target to a free position near the centre; raise ``NotPossible`` if no position is free."""
        width, height = self.scene.width, self.scene.height
        for _ in range(1000):
            x, y = (float(self._rng.uniform(0.35, 0.65)) * side for side in (width, height))
            if np.hypot(self.x - x, self.y - y).min() >= FOOTPRINT_RADIUS_M + 2 * self.scene.target_radius:
                return self.place_target(x, y)
        raise NotPossible("no position near the centre is free; use a larger area per robot")

    def move(self, number: int, x: float, y: float, heading: float) -> None:
        """Move a robot to this position, at rest; raise ``NotPossible`` if another robot or a wall is in the way."""
        scene = self.scene
        inside = (
            FOOTPRINT_RADIUS_M <= x <= scene.width - FOOTPRINT_RADIUS_M
            and FOOTPRINT_RADIUS_M <= y <= scene.height - FOOTPRINT_RADIUS_M
        )
        gap = np.hypot(self.x - x, self.y - y)
        gap[number] = math.inf
        if not (inside and gap.min() >= 2 * FOOTPRINT_RADIUS_M and math.isfinite(heading)):
            raise NotPossible(f"robot {number} does not fit at ({x:.2f}, {y:.2f}); choose a free place")
        for row, value in ((self.x, x), (self.y, y), (self.heading, math.remainder(heading, math.tau))):
            row[number] = value
        for row in (self.vx, self.vy, self.wz, self.ax, self.ay):
            row[number] = 0.0
        self.ranges = self.cast_rays()

    def digest(self) -> str:
        """Return a hash, in hex, of the time and of all poses and velocities; equal runs have equal hashes."""
        state = hashlib.blake2b(struct.pack("<q", self.ticks), digest_size=32)
        for row in (self.x, self.y, self.heading, self.vx, self.vy, self.wz, self.ranges):
            state.update(np.ascontiguousarray(row).tobytes())
        return state.hexdigest()

    def measure_overlap(self) -> float:
        """Return the largest overlap of two robots in metres; 0 if no robots overlap."""
        one, other = self._neighbours.find_pairs(self.x, self.y)
        gaps = np.hypot(self.x[other] - self.x[one], self.y[other] - self.y[one])
        return max(0.0, 2 * FOOTPRINT_RADIUS_M - float(gaps.min(initial=math.inf)))

    def _accelerate(self) -> None:
        """Accelerate all robots towards their commands for one step, as ``Dog.accelerate`` does for one robot."""
        forward, left, turn = (np.clip(self.commands[:, n], low, high) for n, (low, high) in enumerate(_SPANS))
        cos, sin = np.cos(self.heading), np.sin(self.heading)
        error_x, error_y = cos * forward - sin * left - self.vx, sin * forward + cos * left - self.vy
        error = np.hypot(error_x, error_y)
        most = np.where(
            (forward == 0.0) & (left == 0.0) & (turn == 0.0), BRAKING_MPS2 * TICK_S, ACCELERATION_MPS2 * TICK_S
        )
        share = most / np.maximum(error, most)
        self.vx, self.vy = self.vx + share * error_x, self.vy + share * error_y
        most_turn = ANGULAR_ACCELERATION_RADPS2 * TICK_S
        self.wz = self.wz + np.clip(turn - self.wz, -most_turn, most_turn)

    def _resolve_overlaps(self) -> None:
        """Push overlapping robots apart, away from the target and back from the walls; the walls take precedence."""
        x, y = self.x, self.y
        one, other = self._neighbours.find_pairs(x, y)
        close = np.flatnonzero((x[other] - x[one]) ** 2 + (y[other] - y[one]) ** 2 < CLOSE_M * CLOSE_M)
        one, other = one[close], other[close]
        for _ in range(MAX_PUSHES):
            is_at_target = self._push_from_target()
            dx, dy = x[other] - x[one], y[other] - y[one]
            gap = np.hypot(dx, dy)
            met = np.flatnonzero(gap < 2 * FOOTPRINT_RADIUS_M - SLOP_M)
            if not len(met) and not is_at_target:
                break
            gap = np.maximum(gap[met], 1e-9)
            push = CORRECTED_SHARE * (FOOTPRINT_RADIUS_M - gap / 2) / gap
            for row, part in ((x, dx), (y, dy)):
                part = part[met] * push
                row -= np.bincount(one[met], part, len(row))
                row += np.bincount(other[met], part, len(row))
            self._keep_inside()
        self._keep_inside()

    def _push_from_target(self) -> bool:
        """Push robots out of the target; return whether any robot was pushed."""
        if self.target is None:
            return False
        dx, dy = self.x - self.target.x, self.y - self.target.y
        square, room = dx * dx + dy * dy, FOOTPRINT_RADIUS_M + self.target.radius
        inside = np.flatnonzero(square < (room - SLOP_M) ** 2)
        if not len(inside):
            return False
        out = room / np.maximum(np.sqrt(square[inside]), 1e-9) - 1.0
        self.x[inside] += out * dx[inside]
        self.y[inside] += out * dy[inside]
        return True

    def _keep_inside(self) -> None:
        np.clip(self.x, FOOTPRINT_RADIUS_M, self.scene.width - FOOTPRINT_RADIUS_M, out=self.x)
        np.clip(self.y, FOOTPRINT_RADIUS_M, self.scene.height - FOOTPRINT_RADIUS_M, out=self.y)
