"""Dog: the body of one simulated ERS-7 in the physics, moved by velocities with limited acceleration."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import pymunk

from sim.robots.scene import FOOTPRINT, Kennel

LIMITS = {"base.vx": (-0.156, 0.160), "base.vy": (-0.103, 0.103), "base.wz": (-2.03, 2.03)}
"""The walk figures of the ERS-7 in m/s and rad/s (Tekkotsu's stock gait)."""
ACCELERATION = 0.8
BRAKING = 3.0
ANGULAR_ACCELERATION = 12.0
MASS = 1.65
DOG, TARGET, WALL = 1, 2, 3


class Motion(NamedTuple):
    """A velocity in the dog's own frame: m/s forward, m/s to the left, rad/s counter-clockwise."""

    vx: float = 0.0
    vy: float = 0.0
    wz: float = 0.0


REST = Motion()


class Dog:
    """One dog: its place, its command, and the acceleration that its body felt in the newest substep."""

    def __init__(self, kennel: Kennel, number: int) -> None:
        self.name = kennel.name
        self.stripes = kennel.stripes
        self.limits: Mapping[str, tuple[float, float]] = LIMITS
        self.command = REST
        self.felt = (0.0, 0.0)
        self.body = pymunk.Body(MASS, pymunk.moment_for_circle(MASS, 0.0, FOOTPRINT))
        self.body.position = kennel.x, kennel.y
        self.body.angle = kennel.heading
        self.shape = pymunk.Circle(self.body, FOOTPRINT)
        self.shape.friction = 0.3
        self.shape.collision_type = DOG
        # Shapes of one group are not found by the rays that carry the group: a dog does not range itself.
        self.shape.filter = pymunk.ShapeFilter(group=number)
        self.motion = REST
        """The velocity of the body in its own frame, as the newest substep left it."""
        self._before = (0.0, 0.0)

    @property
    def x(self) -> float:
        """Metres from the left wall."""
        return float(self.body.position.x)

    @property
    def y(self) -> float:
        """Metres from the lower wall."""
        return float(self.body.position.y)

    @property
    def heading(self) -> float:
        """Radians, counter-clockwise from the x axis, within -pi and pi."""
        return math.remainder(float(self.body.angle), math.tau)

    @property
    def is_moving(self) -> bool:
        """Whether the dog walks, turns, or is about to."""
        vx, vy, wz = self.motion
        return self.command != REST or math.hypot(vx, vy) > 0.005 or abs(wz) > 0.02

    @property
    def touches(self) -> list[float]:
        """Where something touches it now: radians from straight ahead, left positive."""
        found: list[float] = []

        def note(arbiter: pymunk.Arbiter) -> None:
            for point in arbiter.contact_point_set.points:
                dx, dy = point.point_a[0] - self.x, point.point_a[1] - self.y
                found.append(math.remainder(math.atan2(dy, dx) - self.body.angle, math.tau))

        self.body.each_arbiter(note)
        return found

    def drive(self, motion: Motion) -> None:
        """Move like this from now on, clipped to ``limits``; what has none there is not moved."""
        spans = (self.limits.get(key, (0.0, 0.0)) for key in LIMITS)
        self.command = Motion(*(min(max(v, low), high) for v, (low, high) in zip(motion, spans, strict=True)))

    def strive(self, dt: float) -> None:
        """Bring the velocity as near to the command as the legs can in ``dt`` seconds; called before the physics."""
        velocity = self.body.velocity
        self._before = (velocity.x, velocity.y)
        vx, vy, wz = self.motion
        lack_x, lack_y = self.command.vx - vx, self.command.vy - vy
        lack, can = math.hypot(lack_x, lack_y), (BRAKING if self.command == REST else ACCELERATION) * dt
        share = 1.0 if lack <= can else can / lack
        vx, vy = vx + share * lack_x, vy + share * lack_y
        turn = ANGULAR_ACCELERATION * dt
        angle = self.body.angle
        cos, sin = math.cos(angle), math.sin(angle)
        self.body.velocity = cos * vx - sin * vy, sin * vx + cos * vy
        self.body.angular_velocity = wz + min(max(self.command.wz - wz, -turn), turn)

    def feel(self, dt: float) -> None:
        """Note the acceleration of the substep of ``dt`` seconds in the body's frame; called after the physics."""
        (vx, vy), angle = self.body.velocity, self.body.angle
        cos, sin = math.cos(angle), math.sin(angle)
        ax, ay = (vx - self._before[0]) / dt, (vy - self._before[1]) / dt
        self.felt = (cos * ax + sin * ay, cos * ay - sin * ax)
        self.motion = Motion(cos * vx + sin * vy, cos * vy - sin * vx, float(self.body.angular_velocity))

    def put(self, x: float, y: float, heading: float) -> None:
        """Lift the dog and set it down at rest."""
        self.body.position = x, y
        self.body.angle = heading
        self.body.velocity = 0.0, 0.0
        self.body.angular_velocity = 0.0
        self.felt = (0.0, 0.0)
        self.motion = REST
