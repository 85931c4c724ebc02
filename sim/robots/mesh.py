"""Mesh: the shape and colours of a dog and of its marks, as faces in the dog's own frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Colour = tuple[int, int, int]
"""Blue, green, red, as OpenCV has them."""
Points = NDArray[np.float64]

YELLOW: Colour = (25, 205, 245)
_WHITE: Colour = (226, 226, 222)
_GREY: Colour = (150, 146, 140)
_DARK: Colour = (58, 54, 52)
_LIGHT = np.array([0.42, 0.27, 0.87])

HEAD = ((0.035, 0.145), (-0.058, 0.058), (0.185, 0.300))
"""The head as spans of x, y and z in metres."""


@dataclass(frozen=True)
class Mesh:
    """Faces as quads of ``corners``; a face is seen from the side that its ``normals`` points to.

    ``marks`` lists, for each face, the faces that are painted on it.
    """

    corners: Points
    quads: NDArray[np.int64]
    normals: Points
    centres: Points
    colours: tuple[Colour, ...]
    marks: tuple[tuple[int, ...], ...]
    count: int
    """How many of the faces stand by themselves; the rest are marks."""


class _Builder:
    def __init__(self) -> None:
        self.corners: list[tuple[float, float, float]] = []
        self.faces: list[tuple[tuple[int, ...], Colour, list[tuple[list[tuple[float, float, float]], Colour]]]] = []

    def box(
        self, x: tuple[float, float], y: tuple[float, float], z: tuple[float, float], colour: Colour, stripes: int = 0
    ) -> None:
        start = len(self.corners)
        self.corners += [(x[i & 1], y[i >> 1 & 1], z[i >> 2]) for i in range(8)]
        # Counter-clockwise seen from outside: back, front, right, left, top; nobody sees a dog from below.
        for row in ((2, 0, 4, 6), (1, 3, 7, 5), (0, 1, 5, 4), (3, 2, 6, 7), (4, 5, 7, 6)):
            face = tuple(start + i for i in row)
            self.faces.append((face, colour, _bands([self.corners[i] for i in face], stripes)))


def _bands(
    face: list[tuple[float, float, float]], stripes: int
) -> list[tuple[list[tuple[float, float, float]], Colour]]:
    """``stripes`` upright bands across a face, in its own plane."""
    a, b, c, d = (np.array(point) for point in face)
    share = 1.0 / (2 * stripes + 1) if stripes else 0.0
    made = []
    for number in range(stripes):
        left, right = (2 * number + 1) * share, (2 * number + 2) * share
        quad = [a + left * (b - a), a + right * (b - a), d + right * (c - d), d + left * (c - d)]
        made.append(([tuple(float(part) for part in point) for point in quad], YELLOW))
    return made  # type: ignore[return-value]


def dog_mesh(stripes: int) -> Mesh:
    """An ERS-7 in outline: body, head with ``stripes`` yellow stripes, ears, legs, tail, the shade below.

    The trunk is as high as the target, so that a dog in front of it hides it whole.
    """
    build = _Builder()
    build.box((-0.105, 0.095), (-0.055, 0.055), (0.0, 0.11), _DARK)
    for x in (-0.105, 0.045):
        for y in (-0.082, 0.034):
            build.box((x, x + 0.06), (y, y + 0.048), (0.0, 0.125), _GREY)
    build.box((-0.115, 0.105), (-0.080, 0.080), (0.105, 0.232), _WHITE)
    build.box((-0.130, -0.115), (-0.012, 0.012), (0.150, 0.240), _DARK)
    build.box(*HEAD, _WHITE, stripes)
    build.box((0.145, 0.172), (-0.030, 0.030), (0.190, 0.226), _DARK)
    for y in (-0.072, 0.058):
        build.box((0.045, 0.085), (y, y + 0.014), (0.215, 0.295), _DARK)
    return _meshed(build)


def _meshed(build: _Builder) -> Mesh:
    corners = list(build.corners)
    quads = [list(face) for face, _, _ in build.faces]
    plain = [colour for _, colour, _ in build.faces]
    marks: list[tuple[int, ...]] = []
    for _, _, bands in build.faces:
        numbers = []
        for points, colour in bands:
            numbers.append(len(quads))
            quads.append(list(range(len(corners), len(corners) + 4)))
            plain.append(colour)
            corners += points
        marks.append(tuple(numbers))
    spots = np.array(corners)
    rows = np.array(quads)
    first, second, last = spots[rows[:, 0]], spots[rows[:, 1]], spots[rows[:, 3]]
    normals = np.cross(second - first, last - first)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    shades = 0.80 + 0.20 * np.clip(normals @ _LIGHT, -0.6, 1.0)
    colours = tuple(
        (int(b * shade), int(g * shade), int(r * shade)) for (b, g, r), shade in zip(plain, shades, strict=True)
    )
    return Mesh(spots, rows, normals, spots[rows].mean(axis=1), colours, tuple(marks), len(build.faces))
