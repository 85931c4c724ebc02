"""Size of a crowd's world, number of its robots, and their initial poses."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim.robots.scene import FOOTPRINT, SceneError

Floats = NDArray[np.float64]

MAX_BODIES = 100_000
LONGEST = 2000.0
APART = 0.02
"""Smallest gap in metres between two robots at the start."""
CELL = 2 * FOOTPRINT + APART
ROOM = 4.0
"""Default area per robot in square metres."""


@dataclass(frozen=True)
class Ground:
    """A walled rectangle of ``width`` by ``height`` metres with ``bodies`` round robots of an ERS-7's footprint.

    Raises ``SceneError`` with the remedy for invalid values.
    """

    bodies: int
    width: float
    height: float
    wall_height: float = 0.4
    target_radius: float = 0.08
    target_height: float = 0.22

    def __post_init__(self) -> None:
        if type(self.bodies) is not int or not 1 <= self.bodies <= MAX_BODIES:
            raise SceneError(f"bodies must be a whole number from 1 to {MAX_BODIES}, not {self.bodies!r}")
        for key, lowest, highest in (
            ("width", 1.0, LONGEST),
            ("height", 1.0, LONGEST),
            ("wall_height", 0.05, 2.0),
            ("target_radius", 0.02, 0.3),
            ("target_height", 0.05, 1.0),
        ):
            value = getattr(self, key)
            if not isinstance(value, int | float) or isinstance(value, bool) or not lowest <= value <= highest:
                raise SceneError(f"{key} must be a number from {lowest:g} to {highest:g} metres, not {value!r}")
        places = math.floor(self.width / CELL) * math.floor(self.height / CELL)
        if places < self.bodies:
            side = math.ceil(10 * CELL * math.ceil(math.sqrt(self.bodies))) / 10
            raise SceneError(
                f"{self.bodies} robots of {200 * FOOTPRINT:.0f} cm do not fit into {self.width:g} x {self.height:g} m: "
                f"there is room for {places}; use at most {places} robots, or {side:g} x {side:g} m"
            )

    def places(self, rng: np.random.Generator) -> tuple[Floats, Floats, Floats]:
        """Return the initial x, y and heading of all robots: random, evenly spread, without overlap."""
        pitch = math.sqrt(self.width * self.height / self.bodies)
        while math.floor(self.width / pitch) * math.floor(self.height / pitch) < self.bodies:
            pitch = max(CELL, 0.99 * pitch)
        columns, rows = math.floor(self.width / pitch), math.floor(self.height / pitch)
        cells = rng.permutation(columns * rows)[: self.bodies]
        across, up = self.width / columns, self.height / rows
        loose_x, loose_y = ((pitch - CELL) / 2 * rng.uniform(-1.0, 1.0, self.bodies) for pitch in (across, up))
        heading = rng.uniform(-math.pi, math.pi, self.bodies)
        return (cells % columns + 0.5) * across + loose_x, (cells // columns + 0.5) * up + loose_y, heading


def roomy(bodies: int, room: float = ROOM) -> Ground:
    """Return a square ground with ``room`` square metres per robot; raise ``SceneError`` if that is too little."""
    if type(bodies) is not int or not 1 <= bodies <= MAX_BODIES:
        raise SceneError(f"bodies must be a whole number from 1 to {MAX_BODIES}, not {bodies!r}")
    if not (isinstance(room, int | float) and CELL**2 <= room <= 1000.0):
        raise SceneError(f"room must be a number from {CELL**2:.2f} to 1000 square metres per robot, not {room!r}")
    side = round(max(3.0, math.sqrt(bodies * room)), 2)
    return Ground(bodies, side, side)
