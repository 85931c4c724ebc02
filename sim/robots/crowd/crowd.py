"""Crowd: many round robots in one walled yard as arrays, moved and sensed 32 ms at a time, the same for the same seed.

The robots have the size, the speeds and the legs of the yard's dogs (``sim.robots.dog``).  Contact is geometry: who
overlaps is pushed apart, and its velocity is what became of it.  Metres, radians, seconds; x to the right, y up.
"""

from __future__ import annotations

import hashlib
import math
import struct

import numpy as np

from sim.robots.crowd.ground import Floats, Ground
from sim.robots.crowd.ray import Disc, Neighbours, Rays
from sim.robots.dog import ACCELERATION, ANGULAR_ACCELERATION, BRAKING, LIMITS
from sim.robots.scene import FOOTPRINT
from sim.robots.world import TICK, NotPossible, Target

RAYS = 8
REACH = 1.7
"""Metres of a ray from the middle of a robot: a little more than its far ranger reaches from the nose."""
PUSHES = 12
"""How often in a step those that overlap are pushed apart, at most; only in a throng more than once."""
SHARE = 0.9
"""How much of an overlap a push takes away: those in the middle of a throng are pushed from all sides."""
SLOP = 0.0001
"""Metres of an overlap that is left as it is."""
CLOSE = 2 * FOOTPRINT + 0.03
"""Metres between the middles of two robots that may come to overlap in the pushing of one step."""
SKIN = 0.1
_SPANS = [LIMITS[key] for key in ("base.vx", "base.vy", "base.wz")]


class Crowd:
    """The robots of ``ground``, numbered from 0; the dice of ``seed`` place them.

    ``x y heading`` are their places, ``vx vy wz`` their velocities (of the yard, not of the robot), ``ax ay`` what they
    felt in the newest step, ``wish`` what each is to do (forward, left, turn), ``ranges`` what each ray met.
    """

    def __init__(self, seed: int, ground: Ground) -> None:
        self.ground = ground
        self.target: Target | None = None
        self.ticks = 0
        self._dice = np.random.default_rng(seed)
        self.x, self.y, self.heading = ground.places(self._dice)
        count = ground.bodies
        self.vx, self.vy, self.wz = np.zeros(count), np.zeros(count), np.zeros(count)
        self.ax, self.ay = np.zeros(count), np.zeros(count)
        self.wish = np.zeros((count, 3))
        self._rays = Rays(ground.width, ground.height, RAYS, REACH)
        self._neighbours = Neighbours(CLOSE, SKIN)
        self.ranges = self.cast()

    @property
    def t(self) -> float:
        """Seconds of simulated time since the start."""
        return self.ticks * TICK

    def step(self) -> None:
        """Let ``TICK`` seconds pass."""
        before_x, before_y, before_vx, before_vy = self.x, self.y, self.vx, self.vy
        self._strive()
        self.x, self.y = self.x + self.vx * TICK, self.y + self.vy * TICK
        self.heading = np.remainder(self.heading + self.wz * TICK + math.pi, math.tau) - math.pi
        self._push()
        self.vx, self.vy = (self.x - before_x) / TICK, (self.y - before_y) / TICK
        self.ax, self.ay = (self.vx - before_vx) / TICK, (self.vy - before_vy) / TICK
        self.ranges = self.cast()
        self.ticks += 1

    def cast(self) -> Floats:
        """What each ray of each robot meets now."""
        target = self.target
        discs: list[Disc] = [] if target is None else [(target.x, target.y, target.radius)]
        return self._rays.cast(self.x, self.y, self.heading, discs)

    def place_target(self, x: float, y: float) -> None:
        """Put the target here, in place of an older one; raises ``NotPossible`` where a robot or a wall is."""
        ground = self.ground
        radius = ground.target_radius
        if not (radius <= x <= ground.width - radius and radius <= y <= ground.height - radius):
            raise NotPossible(
                f"the target does not fit at ({x:.2f}, {y:.2f}); x must be {radius:g} to {ground.width - radius:g}, "
                f"y {radius:g} to {ground.height - radius:g}"
            )
        gap = np.hypot(self.x - x, self.y - y)
        if gap.min() < FOOTPRINT + radius:
            raise NotPossible(f"robot {int(gap.argmin())} stands at ({x:.2f}, {y:.2f}); choose a free place")
        self.target = Target(x, y, radius, ground.target_height)
        self.ranges = self.cast()

    def place_target_at_random(self) -> None:
        """Put the target at a free place about the middle; raises ``NotPossible`` where there is none."""
        width, height = self.ground.width, self.ground.height
        for _ in range(1000):
            x, y = (float(self._dice.uniform(0.35, 0.65)) * side for side in (width, height))
            if np.hypot(self.x - x, self.y - y).min() >= FOOTPRINT + 2 * self.ground.target_radius:
                return self.place_target(x, y)
        raise NotPossible("no place is free about the middle; give the robots more room")

    def move(self, body: int, x: float, y: float, heading: float) -> None:
        """Lift a robot and set it down at rest; raises ``NotPossible`` where another robot or a wall is."""
        ground = self.ground
        inside = FOOTPRINT <= x <= ground.width - FOOTPRINT and FOOTPRINT <= y <= ground.height - FOOTPRINT
        gap = np.hypot(self.x - x, self.y - y)
        gap[body] = math.inf
        if not (inside and gap.min() >= 2 * FOOTPRINT and math.isfinite(heading)):
            raise NotPossible(f"robot {body} does not fit at ({x:.2f}, {y:.2f}); choose a free place")
        for row, value in ((self.x, x), (self.y, y), (self.heading, math.remainder(heading, math.tau))):
            row[body] = value
        for row in (self.vx, self.vy, self.wz, self.ax, self.ay):
            row[body] = 0.0
        self.ranges = self.cast()

    def digest(self) -> str:
        """The hash, in hex, of the moment and of all places and velocities: two runs that are alike have the same."""
        state = hashlib.blake2b(struct.pack("<q", self.ticks), digest_size=32)
        for row in (self.x, self.y, self.heading, self.vx, self.vy, self.wz, self.ranges):
            state.update(np.ascontiguousarray(row).tobytes())
        return state.hexdigest()

    def overlap(self) -> float:
        """Metres by which the two robots overlap that do so the most; 0 where none do."""
        one, other = self._neighbours.pairs(self.x, self.y)
        gaps = np.hypot(self.x[other] - self.x[one], self.y[other] - self.y[one])
        return max(0.0, 2 * FOOTPRINT - float(gaps.min(initial=math.inf)))

    def _strive(self) -> None:
        """Bring the velocities as near to the wishes as the legs can in one step, as ``Dog.strive`` does for one."""
        forward, left, turn = (np.clip(self.wish[:, n], low, high) for n, (low, high) in enumerate(_SPANS))
        cos, sin = np.cos(self.heading), np.sin(self.heading)
        lack_x, lack_y = cos * forward - sin * left - self.vx, sin * forward + cos * left - self.vy
        lack = np.hypot(lack_x, lack_y)
        can = np.where((forward == 0.0) & (left == 0.0) & (turn == 0.0), BRAKING * TICK, ACCELERATION * TICK)
        share = can / np.maximum(lack, can)
        self.vx, self.vy = self.vx + share * lack_x, self.vy + share * lack_y
        most = ANGULAR_ACCELERATION * TICK
        self.wz = self.wz + np.clip(turn - self.wz, -most, most)

    def _push(self) -> None:
        """Push apart who overlaps, away from the target and back from the walls; the walls have the last word."""
        x, y = self.x, self.y
        one, other = self._neighbours.pairs(x, y)
        close = np.flatnonzero((x[other] - x[one]) ** 2 + (y[other] - y[one]) ** 2 < CLOSE * CLOSE)
        one, other = one[close], other[close]
        for _ in range(PUSHES):
            is_at_target = self._push_from_target()
            dx, dy = x[other] - x[one], y[other] - y[one]
            gap = np.hypot(dx, dy)
            met = np.flatnonzero(gap < 2 * FOOTPRINT - SLOP)
            if not len(met) and not is_at_target:
                break
            gap = np.maximum(gap[met], 1e-9)
            push = SHARE * (FOOTPRINT - gap / 2) / gap
            for row, part in ((x, dx), (y, dy)):
                part = part[met] * push
                row -= np.bincount(one[met], part, len(row))
                row += np.bincount(other[met], part, len(row))
            self._keep_inside()
        self._keep_inside()

    def _push_from_target(self) -> bool:
        """Whether somebody was in the target."""
        if self.target is None:
            return False
        dx, dy = self.x - self.target.x, self.y - self.target.y
        square, room = dx * dx + dy * dy, FOOTPRINT + self.target.radius
        inside = np.flatnonzero(square < (room - SLOP) ** 2)
        if not len(inside):
            return False
        out = room / np.maximum(np.sqrt(square[inside]), 1e-9) - 1.0
        self.x[inside] += out * dx[inside]
        self.y[inside] += out * dy[inside]
        return True

    def _keep_inside(self) -> None:
        np.clip(self.x, FOOTPRINT, self.ground.width - FOOTPRINT, out=self.x)
        np.clip(self.y, FOOTPRINT, self.ground.height - FOOTPRINT, out=self.y)
