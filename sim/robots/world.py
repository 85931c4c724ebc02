"""Physics of the walled world, in steps of 8 ms; deterministic for a given seed.

This module has no sensors, pictures or connections. Units are metres, radians and seconds; x is to the right, y up.
"""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import dataclass
from random import Random

import pymunk

from sim.robots.dog import DOG, REST, TARGET, WALL, Dog, Motion
from sim.robots.scene import FOOTPRINT_RADIUS_M, Scene

SUBSTEP_S = 0.008
"""Duration of one ``step`` in seconds; the ERS-7 samples its sensors at this interval."""
SUBSTEPS = 4
TICK_S = SUBSTEPS * SUBSTEP_S
"""Duration of one tick in seconds: one sensor frame of the ERS-7."""
WALL_THICKNESS_M = 0.04
MAX_TRIES = 2000
CLEARANCE_M, DISTANCE_GAP_M, FROM_WALLS_M = 0.75, 0.25, 0.25
"""Minimum distances in metres for a random target: to a dog; between its distances to two dogs; to a wall."""
MAX_DELAY_S = 3600.0
"""Maximum delay in seconds after which a target can be placed."""


class NotPossible(ValueError):
    """The operator's command is not possible; the message contains the reason and the remedy."""


@dataclass(frozen=True)
class Target:
    """The upright red cylinder."""

    x: float
    y: float
    radius: float
    height: float


class World:
    """The arena of ``scene``: dogs that collide with each other and with walls, and at most one fixed target."""

    def __init__(self, rng: Random, scene: Scene) -> None:
        self.scene = scene
        self.target: Target | None = None
        self.collisions = 0
        self._rng = rng
        self._steps = 0
        self._place_target_at = math.inf
        self._space = pymunk.Space()
        # The library's default is meant for pixels: in metres, bodies would overlap by 10 cm.
        self._space.collision_slop = 0.001
        self._target_shape: pymunk.Shape | None = None
        self._build_walls()
        self.dogs: dict[str, Dog] = {}
        for number, placement in enumerate(scene.dogs, 1):
            dog = self.dogs[placement.name] = Dog(placement, number)
            self._space.add(dog.body, dog.shape)
        for other in (DOG, TARGET, WALL):
            self._space.on_collision(DOG, other, begin=self._on_collision)

    @property
    def t(self) -> float:
        """Simulated time in seconds since the start."""
        return self._steps * SUBSTEP_S

    @property
    def walls(self) -> list[tuple[float, float, float, float]]:
        """The inner faces of the walls as x1, y1, x2, y2, counter-clockwise from the lower wall."""
        width, height = self.scene.width, self.scene.height
        corners = [(0.0, 0.0), (width, 0.0), (width, height), (0.0, height)]
        return [(*corners[i], *corners[(i + 1) % 4]) for i in range(4)]

    def step(self) -> None:
        """Simulate ``SUBSTEP_S`` seconds."""
        if self.t >= self._place_target_at:
            self._place_target_at = math.inf
            with suppress(NotPossible):  # no position is free, and no caller waits for an answer
                self.place_target_at_random()
        for dog in self.dogs.values():
            dog.accelerate(SUBSTEP_S)
        self._space.step(SUBSTEP_S)
        for dog in self.dogs.values():
            dog.record_motion(SUBSTEP_S)
        self._steps += 1

    def drive(self, name: str, vx: float, vy: float, wz: float) -> None:
        """Set the dog's velocity in its frame, until the next command."""
        self.dogs[name].drive(Motion(vx, vy, wz))

    def halt(self, name: str) -> None:
        """Stop the dog, braking as hard as it can."""
        self.dogs[name].command = REST

    def distance_ahead(self, dog: Dog, forward: float, reach: float) -> float | None:
        """Return metres from the point ``forward`` metres ahead of the centre to an obstacle; None beyond ``reach``."""
        cos, sin = math.cos(dog.body.angle), math.sin(dog.body.angle)
        x, y = dog.x + forward * cos, dog.y + forward * sin
        hit = self._space.segment_query_first((x, y), (x + reach * cos, y + reach * sin), 0.0, dog.shape.filter)
        return None if hit is None else hit.alpha * reach

    def place_target(self, x: float, y: float) -> None:
        """Move the target to this position; raise ``NotPossible`` if a dog or a wall is in the way."""
        radius = self.scene.target_radius
        self._check_inside("the target", x, y, radius)
        for dog in self.dogs.values():
            if math.hypot(dog.x - x, dog.y - y) < FOOTPRINT_RADIUS_M + radius:
                raise NotPossible(f"{dog.name} stands at ({x:.2f}, {y:.2f}); choose a free place")
        self.clear_target()
        self.target = Target(x, y, radius, self.scene.target_height)
        shape = pymunk.Circle(self._space.static_body, radius, (x, y))
        shape.friction = 0.3
        shape.collision_type = TARGET
        self._target_shape = shape
        self._space.add(shape)

    def place_target_at_random(self) -> None:
        """Move the target to a free position, ``CLEARANCE_M`` from every dog, so that one dog is clearly the nearest.

        The distances to the dogs differ pairwise by ``DISTANCE_GAP_M``. If no position meets both conditions, the best
        position is used. Raises ``NotPossible`` if no position is free.
        """
        best, best_fit = None, -math.inf
        for _ in range(MAX_TRIES):
            x = self._rng.uniform(FROM_WALLS_M, self.scene.width - FROM_WALLS_M)
            y = self._rng.uniform(FROM_WALLS_M, self.scene.height - FROM_WALLS_M)
            distances = sorted(math.hypot(dog.x - x, dog.y - y) for dog in self.dogs.values())
            if distances and distances[0] < FOOTPRINT_RADIUS_M + 2 * self.scene.target_radius:
                continue
            gap = min((b - a for a, b in zip(distances, distances[1:], strict=False)), default=DISTANCE_GAP_M)
            room = distances[0] if distances else CLEARANCE_M
            fit = min(gap / DISTANCE_GAP_M, 1.0) + min(room / CLEARANCE_M, 1.0)
            if fit > best_fit:
                best, best_fit = (x, y), fit
        if best is None:
            raise NotPossible("no place is free; move the dogs apart")
        self.place_target(*best)

    def place_target_later(self, seconds: float) -> None:
        """Move the target to a free position after ``seconds``, unless it has been placed or removed by then."""
        if not 0.0 <= seconds <= MAX_DELAY_S:
            raise NotPossible(f"the delay of the target must be from 0 to {MAX_DELAY_S:g} s, not {seconds:g}")
        self._place_target_at = self.t + seconds

    def clear_target(self) -> None:
        """Remove the target, if there is one."""
        self._place_target_at = math.inf
        if self._target_shape is not None:
            self._space.remove(self._target_shape)
        self.target = self._target_shape = None

    def move_dog(self, name: str, x: float, y: float, heading: float) -> None:
        """Move a dog to this position; raise ``NotPossible`` for an unknown dog or an occupied position."""
        dog = self.dogs.get(name)
        if dog is None:
            raise NotPossible(f"no dog is named {name!r}; known are {', '.join(self.dogs)}")
        self._check_inside(name, x, y, FOOTPRINT_RADIUS_M)
        if not math.isfinite(heading):
            raise NotPossible("a heading must be a finite number of radians")
        for other in self.dogs.values():
            if other is not dog and math.hypot(other.x - x, other.y - y) < 2 * FOOTPRINT_RADIUS_M:
                raise NotPossible(f"{other.name} stands at ({x:.2f}, {y:.2f}); choose a free place")
        if (
            self.target is not None
            and math.hypot(self.target.x - x, self.target.y - y) < FOOTPRINT_RADIUS_M + self.target.radius
        ):
            raise NotPossible(f"the target stands at ({x:.2f}, {y:.2f}); choose a free place")
        self._place_dog(dog, x, y, heading)

    def scatter(self, seed: int, clearance: float = 0.45, from_walls: float = 0.3) -> None:
        """Move all dogs to random free positions, at rest; the same ``seed`` gives the same positions."""
        rng = Random(seed)
        taken = [] if self.target is None else [(self.target.x, self.target.y)]
        places = []
        for _ in self.dogs:
            for _ in range(MAX_TRIES):
                x = rng.uniform(from_walls, self.scene.width - from_walls)
                y = rng.uniform(from_walls, self.scene.height - from_walls)
                if all(math.hypot(x - a, y - b) >= clearance for a, b in taken):
                    break
            else:
                raise NotPossible(
                    f"the world is too small to keep {len(self.dogs)} dogs {clearance} m apart; use a larger scene"
                )
            taken.append((x, y))
            places.append((x, y, rng.uniform(-math.pi, math.pi)))
        for dog, place in zip(self.dogs.values(), places, strict=True):
            self._place_dog(dog, *place)

    def snapshot(self) -> dict[str, object]:
        """Return the true state as plain data, for the map and the judge."""
        target = self.target
        return {
            "t": self.t,
            "walls": [self.scene.width, self.scene.height],
            "dogs": [
                {
                    "name": dog.name,
                    "x": dog.x,
                    "y": dog.y,
                    "heading": dog.heading,
                    "moving": dog.is_moving,
                    "stripes": dog.stripes,
                }
                for dog in self.dogs.values()
            ],
            "target": None if target is None else {"x": target.x, "y": target.y, "radius": target.radius},
            "collisions": self.collisions,
        }

    def _place_dog(self, dog: Dog, x: float, y: float, heading: float) -> None:
        dog.place(x, y, heading)
        self._space.reindex_shapes_for_body(dog.body)

    def _check_inside(self, what: str, x: float, y: float, radius: float) -> None:
        inside = radius <= x <= self.scene.width - radius and radius <= y <= self.scene.height - radius
        if not inside:
            raise NotPossible(
                f"{what} does not fit at ({x:.2f}, {y:.2f}); "
                f"x must be {radius:g} to {self.scene.width - radius:g}, y {radius:g} to {self.scene.height - radius:g}"
            )

    def _build_walls(self) -> None:
        half = WALL_THICKNESS_M / 2
        for x1, y1, x2, y2 in self.walls:
            # The thickness prevents tunnelling; the wall is outside of the boundary, which is its inner face.
            length = math.hypot(x2 - x1, y2 - y1)
            out_x, out_y = half * (y2 - y1) / length, -half * (x2 - x1) / length
            wall = pymunk.Segment(self._space.static_body, (x1 + out_x, y1 + out_y), (x2 + out_x, y2 + out_y), half)
            wall.friction = 0.3
            wall.collision_type = WALL
            self._space.add(wall)

    def _on_collision(self, _arbiter: pymunk.Arbiter, _space: pymunk.Space, _data: object) -> None:
        self.collisions += 1
