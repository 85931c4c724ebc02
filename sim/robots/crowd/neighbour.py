"""Neighbours: which of many bodies are near each other, found by cells and remembered while nobody has gone far."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sim.robots.crowd.ground import Floats

Places = NDArray[np.int64]


class Neighbours:
    """The pairs of bodies whose middles are within ``reach`` metres of each other.

    They are looked for ``skin`` metres farther, so that the list holds until somebody has gone half of that: a search
    in cells of the whole yard becomes one in some dozens of steps.
    """

    def __init__(self, reach: float, skin: float) -> None:
        self._reach = reach
        self._skin = skin
        self._found: tuple[Floats, Floats, Places, Places] | None = None

    def pairs(self, x: Floats, y: Floats) -> tuple[Places, Places]:
        """Each pair once, as two rows of numbers of bodies; some of them may be farther apart than ``reach``."""
        if self._found is not None:
            then_x, then_y, one, other = self._found
            gone = (x - then_x) ** 2 + (y - then_y) ** 2
            if gone.max() <= (self._skin / 2) ** 2:
                return one, other
        one, other = near(x, y, self._reach + self._skin)
        self._found = x.copy(), y.copy(), one, other
        return one, other


def near(x: Floats, y: Floats, reach: float) -> tuple[Places, Places]:
    """The pairs within ``reach``, each once."""
    # Sorted by cells of that size, whoever may be near lies in two runs: the rest of its own cell with the next one
    # above, and the three cells beside those in the next column.
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
