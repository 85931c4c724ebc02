"""Distances from every robot to its surroundings along rays, and pairs of robots that are near each other."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sim.robots.crowd.scene import Floats
from sim.robots.scene import FOOTPRINT_RADIUS_M

Indices = NDArray[np.int64]
SKIN_M = 0.3
Disc = tuple[float, float, float]
"""A fixed round obstacle: x, y and radius in metres."""


class Rays:
    """``count`` rays of ``reach`` metres from the centre of each robot, at equal angles; ray 0 points ahead.

    For each disc, the rays that meet it are computed, so the cost grows with the number of discs, not with the number
    of rays.
    """

    def __init__(self, width: float, height: float, count: int, reach: float) -> None:
        self._width = width
        self._height = height
        self._count = count
        self._reach = reach
        self._between = math.tau / count
        self._neighbours = Neighbours(reach + FOOTPRINT_RADIUS_M, SKIN_M)

    def cast(self, x: Floats, y: Floats, heading: Floats, discs: Sequence[Disc] = ()) -> Floats:
        """Return metres along each ray, a row per robot, counter-clockwise; ``reach`` if the ray meets nothing."""
        ranges = np.full((len(x), self._count), self._reach)
        self._shorten_at_walls(ranges, x, y, heading)
        one, other = self._neighbours.find_pairs(x, y)
        dx, dy = x[other] - x[one], y[other] - y[one]
        square = dx * dx + dy * dy
        is_near = np.flatnonzero(square < (self._reach + FOOTPRINT_RADIUS_M) ** 2)
        one, other = one[is_near], other[is_near]
        distance, towards = np.sqrt(square[is_near]), np.arctan2(dy[is_near], dx[is_near])
        # Each pair is used in both directions.
        self._shorten(
            ranges,
            np.concatenate((one, other)),
            np.concatenate((towards - heading[one], towards + math.pi - heading[other])),
            np.concatenate((distance, distance)),
            FOOTPRINT_RADIUS_M,
        )
        for disc_x, disc_y, radius in discs:
            dx, dy = disc_x - x, disc_y - y
            square = dx * dx + dy * dy
            observers = np.flatnonzero(square < (self._reach + radius) ** 2)
            towards = np.arctan2(dy[observers], dx[observers]) - heading[observers]
            self._shorten(ranges, observers, towards, np.sqrt(square[observers]), radius)
        return ranges

    def _shorten(self, ranges: Floats, observers: Indices, bearing: Floats, distance: Floats, radius: float) -> None:
        """Shorten the rays of ``observers``, each of which meets a disc at ``bearing`` (0: ahead) and ``distance``."""
        half = np.arcsin(np.minimum(radius / distance, 1.0)) / self._between
        middle = bearing / self._between
        first = np.ceil(middle - half)
        count = np.floor(middle + half) - first + 1.0
        flat = ranges.reshape(-1)
        nth = 0
        met = np.flatnonzero(count > 0)
        while len(met):
            ray = first[met] + nth
            off = (ray - middle[met]) * self._between
            far = distance[met]
            lateral = far * np.sin(off)
            along = far * np.cos(off) - np.sqrt(np.maximum(radius * radius - lateral * lateral, 0.0))
            # Several discs can shorten the same ray; the smallest distance is kept.
            np.minimum.at(flat, observers[met] * self._count + ray.astype(np.int64) % self._count, along)
            nth += 1
            met = met[count[met] > nth]

    def _shorten_at_walls(self, ranges: Floats, x: Floats, y: Floats, heading: Floats) -> None:
        gap = np.minimum(np.minimum(x, self._width - x), np.minimum(y, self._height - y))
        close = np.flatnonzero(gap < self._reach)
        if not len(close):
            return
        x, y = x[close, None], y[close, None]
        angle = heading[close, None] + np.arange(self._count) * self._between
        cos, sin = np.cos(angle), np.sin(angle)
        with np.errstate(divide="ignore"):  # a ray parallel to a wall never meets it
            across = np.where(cos > 0.0, self._width - x, x) / np.abs(cos)
            up = np.where(sin > 0.0, self._height - y, y) / np.abs(sin)
        ranges[close] = np.minimum(ranges[close], np.minimum(across, up))


class Neighbours:
    """The pairs of bodies with centres within ``reach`` metres of each other.

    The search radius is larger by ``skin`` metres, so the list of pairs stays valid until a body has moved by half of
    ``skin``. A search is therefore needed only once in some dozens of steps.
    """

    def __init__(self, reach: float, skin: float) -> None:
        self._reach = reach
        self._skin = skin
        self._cached_pairs: tuple[Floats, Floats, Indices, Indices] | None = None

    def find_pairs(self, x: Floats, y: Floats) -> tuple[Indices, Indices]:
        """Return each pair once, as two rows of numbers; some pairs may be farther apart than ``reach``."""
        if self._cached_pairs is not None:
            then_x, then_y, one, other = self._cached_pairs
            moved = (x - then_x) ** 2 + (y - then_y) ** 2
            if moved.max() <= (self._skin / 2) ** 2:
                return one, other
        one, other = find_near_pairs(x, y, self._reach + self._skin)
        self._cached_pairs = x.copy(), y.copy(), one, other
        return one, other


def find_near_pairs(x: Floats, y: Floats, reach: float) -> tuple[Indices, Indices]:
    """Return the pairs within ``reach``, each once."""
    # In an array sorted by cells of size ``reach``, the candidates for a body are in two ranges: the rest of its cell
    # and the next cell above, and the three adjacent cells in the next column.
    column = np.floor(x / reach).astype(np.int64)
    row = np.floor(y / reach).astype(np.int64)
    rows = int(row.max()) + 3
    key = column * rows + row
    order = np.argsort(key, kind="stable")
    key = key[order]
    here = np.arange(len(key))
    ones, others = [], []
    for first, end in (
        (here + 1, np.searchsorted(key, key + 1, "right")),
        (np.searchsorted(key, key + rows - 1, "left"), np.searchsorted(key, key + rows + 1, "right")),
    ):
        count = end - first
        ones.append(np.repeat(here, count))
        others.append(np.arange(int(count.sum())) + np.repeat(first - np.cumsum(count) + count, count))
    one, other = order[np.concatenate(ones)], order[np.concatenate(others)]
    is_near = (x[other] - x[one]) ** 2 + (y[other] - y[one]) ** 2 <= reach * reach
    return one[is_near], other[is_near]
