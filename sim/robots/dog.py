"""Physics of one simulated ERS-7, controlled by velocities with limited acceleration."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import pymunk

from sim.robots.scene import FOOTPRINT_RADIUS_M, DogPlacement

LIMITS = {"base.vx": (-0.156, 0.160), "base.vy": (-0.103, 0.103), "base.wz": (-2.03, 2.03)}
"""Speed limits of the ERS-7 in m/s and rad/s (Tekkotsu's stock gait)."""
ACCELERATION_MPS2 = 0.8
BRAKING_MPS2 = 3.0
ANGULAR_ACCELERATION_RADPS2 = 12.0
MASS_KG = 1.65
DOG, TARGET, WALL = 1, 2, 3


class Motion(NamedTuple):
    """A velocity in the dog's frame: m/s forward, m/s to the left, rad/s counter-clockwise."""

    vx: float = 0.0
    vy: float = 0.0
    wz: float = 0.0


REST = Motion()


class Dog:
    """One dog: its position, its command, and its acceleration in the last substep."""

    def __init__(self, placement: DogPlacement, number: int) -> None:
        self.name = placement.name
        self.stripes = placement.stripes
        self.limits: Mapping[str, tuple[float, float]] = LIMITS
        self.command = REST
        self.acceleration = (0.0, 0.0)
        self.body = pymunk.Body(MASS_KG, pymunk.moment_for_circle(MASS_KG, 0.0, FOOTPRINT_RADIUS_M))
        self.body.position = placement.x, placement.y
        self.body.angle = placement.heading
        self.shape = pymunk.Circle(self.body, FOOTPRINT_RADIUS_M)
        self.shape.friction = 0.3
        self.shape.collision_type = DOG
        # Rays ignore shapes of the dog's own group: a dog does not measure the distance to itself.
        self.shape.filter = pymunk.ShapeFilter(group=number)
        self.motion = REST
        """The velocity in the dog's frame after the newest substep."""
        self._previous_velocity = (0.0, 0.0)

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
        """Whether the dog moves, or has a command to move."""
        vx, vy, wz = self.motion
        return self.command != REST or math.hypot(vx, vy) > 0.005 or abs(wz) > 0.02

    @property
    def contact_directions(self) -> list[float]:
        """Directions of current contacts: radians from straight ahead, left positive."""
        found: list[float] = []

        def note(arbiter: pymunk.Arbiter) -> None:
            for point in arbiter.contact_point_set.points:
                dx, dy = point.point_a[0] - self.x, point.point_a[1] - self.y
                found.append(math.remainder(math.atan2(dy, dx) - self.body.angle, math.tau))

        self.body.each_arbiter(note)
        return found

    def drive(self, motion: Motion) -> None:
        """Set the commanded velocity, clipped to ``limits``; an axis without limits is 0."""
        spans = (self.limits.get(key, (0.0, 0.0)) for key in LIMITS)
        self.command = Motion(*(min(max(v, low), high) for v, (low, high) in zip(motion, spans, strict=True)))

    def accelerate(self, dt: float) -> None:
        """Accelerate towards the command for ``dt`` seconds; called before the physics step."""
        velocity = self.body.velocity
        self._previous_velocity = (velocity.x, velocity.y)
        vx, vy, wz = self.motion
        error_x, error_y = self.command.vx - vx, self.command.vy - vy
        error, most = math.hypot(error_x, error_y), (BRAKING_MPS2 if self.command == REST else ACCELERATION_MPS2) * dt
        share = 1.0 if error <= most else most / error
        vx, vy = vx + share * error_x, vy + share * error_y
        turn = ANGULAR_ACCELERATION_RADPS2 * dt
        angle = self.body.angle
        cos, sin = math.cos(angle), math.sin(angle)
        self.body.velocity = cos * vx - sin * vy, sin * vx + cos * vy
        self.body.angular_velocity = wz + min(max(self.command.wz - wz, -turn), turn)

    def record_motion(self, dt: float) -> None:
        """Store the acceleration of a substep of ``dt`` seconds in the dog's frame; called after the physics step."""
        (vx, vy), angle = self.body.velocity, self.body.angle
        cos, sin = math.cos(angle), math.sin(angle)
        ax, ay = (vx - self._previous_velocity[0]) / dt, (vy - self._previous_velocity[1]) / dt
        self.acceleration = (cos * ax + sin * ay, cos * ay - sin * ax)
        self.motion = Motion(cos * vx + sin * vy, cos * vy - sin * vx, float(self.body.angular_velocity))

    def place(self, x: float, y: float, heading: float) -> None:
        """Move the dog to this position, at rest."""
        self.body.position = x, y
        self.body.angle = heading
        self.body.velocity = 0.0, 0.0
        self.body.angular_velocity = 0.0
        self.acceleration = (0.0, 0.0)
        self.motion = REST
