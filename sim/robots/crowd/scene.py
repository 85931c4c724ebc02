"""Size of a crowd's world, number of its robots, and their initial poses."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim.robots.scene import FOOTPRINT_RADIUS_M, SceneError

Floats = NDArray[np.float64]

MAX_ROBOTS = 100_000
MAX_SIDE_M = 2000.0
GAP_M = 0.02
"""Minimum gap in metres between two robots at the start."""
CELL_M = 2 * FOOTPRINT_RADIUS_M + GAP_M
AREA_M2 = 4.0
"""Default area per robot in square metres."""


@dataclass(frozen=True)
class CrowdScene:
    """A walled rectangle of ``width`` by ``height`` metres with ``robots`` round robots of an ERS-7's footprint.

    Raises ``SceneError`` with the remedy for invalid values.
    """

    robots: int
    width: float
    height: float
    wall_height: float = 0.4
    target_radius: float = 0.08
    target_height: float = 0.22

    def __post_init__(self) -> None:
        if type(self.robots) is not int or not 1 <= self.robots <= MAX_ROBOTS:
            raise SceneError(f"bodies must be a whole number from 1 to {MAX_ROBOTS}, not {self.robots!r}")
        for key, lowest, highest in (
            ("width", 1.0, MAX_SIDE_M),
            ("height", 1.0, MAX_SIDE_M),
            ("wall_height", 0.05, 2.0),
            ("target_radius", 0.02, 0.3),
            ("target_height", 0.05, 1.0),
        ):
            value = getattr(self, key)
            if not isinstance(value, int | float) or isinstance(value, bool) or not lowest <= value <= highest:
                raise SceneError(f"{key} must be a number from {lowest:g} to {highest:g} metres, not {value!r}")
        places = math.floor(self.width / CELL_M) * math.floor(self.height / CELL_M)
        if places < self.robots:
            side = math.ceil(10 * CELL_M * math.ceil(math.sqrt(self.robots))) / 10
            raise SceneError(
                f"{self.robots} robots of {200 * FOOTPRINT_RADIUS_M:.0f} cm do not fit into"
                f" {self.width:g} x {self.height:g} m: "
                f"at most {places} fit; use at most {places} robots, or {side:g} x {side:g} m"
            )

    def draw_poses(self, rng: np.random.Generator) -> tuple[Floats, Floats, Floats]:
        """Return the initial x, y and heading of all robots: random, evenly spread, without overlap."""
        pitch = math.sqrt(self.width * self.height / self.robots)
        while math.floor(self.width / pitch) * math.floor(self.height / pitch) < self.robots:
            pitch = max(CELL_M, 0.99 * pitch)
        columns, rows = math.floor(self.width / pitch), math.floor(self.height / pitch)
        cells = rng.permutation(columns * rows)[: self.robots]
        across, up = self.width / columns, self.height / rows
        loose_x, loose_y = ((pitch - CELL_M) / 2 * rng.uniform(-1.0, 1.0, self.robots) for pitch in (across, up))
        heading = rng.uniform(-math.pi, math.pi, self.robots)
        return (cells % columns + 0.5) * across + loose_x, (cells // columns + 0.5) * up + loose_y, heading


def make_square_scene(robots: int, room: float = AREA_M2) -> CrowdScene:
    """Return a square scene with ``room`` square metres per robot; raise ``SceneError`` if that is too little."""
    if type(robots) is not int or not 1 <= robots <= MAX_ROBOTS:
        raise SceneError(f"bodies must be a whole number from 1 to {MAX_ROBOTS}, not {robots!r}")
    if not (isinstance(room, int | float) and CELL_M**2 <= room <= 1000.0):
        raise SceneError(f"room must be a number from {CELL_M**2:.2f} to 1000 square metres per robot, not {room!r}")
    side = round(max(3.0, math.sqrt(robots * room)), 2)
    return CrowdScene(robots, side, side)
