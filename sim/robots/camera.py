"""Render a dog's camera with the painter's algorithm: 208x160 pixels, 56.9 by 45.2 degrees like the ERS-7."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from random import Random

import cv2
import numpy as np

from sim.robots.dog import Dog
from sim.robots.rendering import (
    LENS_HEIGHT_M,
    NEAR_PLANE_M,
    SUBPIXEL_BITS,
    CameraFrame,
    Colour,
    Image,
    Points,
    Room,
    draw_shadow,
    draw_target,
    encode_jpeg,
    fill_polygon,
    project,
)
from sim.robots.world import Target, World

TILE_M = 0.3
_JOINT: Colour = (96, 118, 106)
_YELLOW: Colour = (25, 205, 245)
_WHITE: Colour = (226, 226, 222)
_GREY: Colour = (150, 146, 140)
_DARK: Colour = (58, 54, 52)
_LIGHT = np.array([0.42, 0.27, 0.87])
_FACES = ((2, 0, 4, 6), (1, 3, 7, 5), (0, 1, 5, 4), (3, 2, 6, 7), (4, 5, 7, 6))
"""The back, front, right, left and top of a box as indices of corners, counter-clockwise seen from outside."""

Span = tuple[float, float]


class Camera:
    """The cameras of all dogs of ``world``; ``rng`` generates the noise, so equal seeds give equal pictures."""

    def __init__(self, rng: Random, world: World) -> None:
        self._world = world
        self._room = Room(rng, world.scene.width, world.scene.height, world.scene.wall_height)
        self._meshes = {name: _make_dog_mesh(dog.stripes) for name, dog in world.dogs.items()}
        self._joints = _make_joints(world.scene.width, world.scene.height)

    def render_jpeg(self, dog: Dog, is_halved: bool = False) -> bytes:
        """Return the picture as a JPEG, optionally at half the width and height."""
        return encode_jpeg(self.render_image(dog), is_halved)

    def render_image(self, dog: Dog) -> Image:
        """Return the picture as blue, green and red bytes, with sensor noise."""
        view = CameraFrame(dog.x, dog.y, dog.body.angle)
        image = self._room.draw_floor()
        self._draw_joints(image, view)
        self._room.draw_walls(image, view)
        things: list[tuple[float, int, Dog | Target]] = [
            (math.hypot(other.x - view.x, other.y - view.y), number, other)
            for number, other in enumerate(self._world.dogs.values())
            if other is not dog
        ]
        if self._world.target is not None:
            target = self._world.target
            things.append((math.hypot(target.x - view.x, target.y - view.y), len(things) + 1, target))
        for _, _, thing in sorted(things, key=lambda entry: (-entry[0], entry[1])):
            if isinstance(thing, Target):
                draw_target(image, view, thing.x, thing.y, thing.radius, thing.height)
            else:
                _draw_dog(image, view, thing, self._meshes[thing.name])
        return self._room.add_noise(image)

    def _draw_joints(self, image: Image, view: CameraFrame) -> None:
        seen = view.transform(self._joints).reshape(-1, 2, 3)
        ahead = seen[:, :, 0]
        seen = seen[ahead.max(axis=1) > NEAR_PLANE_M]
        one, other = seen[:, 0], seen[:, 1]
        for end, opposite in ((one, other), (other, one)):
            behind = end[:, 0] < NEAR_PLANE_M
            if behind.any():
                start, stop = end[behind], opposite[behind]
                share = (NEAR_PLANE_M - start[:, 0]) / (stop[:, 0] - start[:, 0])
                end[behind] = start + share[:, None] * (stop - start)
        lines = project(seen.reshape(-1, 3)).reshape(-1, 2, 2)
        cv2.polylines(image, list(lines), False, _JOINT, 1, cv2.LINE_AA, SUBPIXEL_BITS)


def _draw_dog(image: Image, view: CameraFrame, dog: Dog, mesh: _Mesh) -> None:
    x, y = dog.x - view.x, dog.y - view.y
    ahead, left = view.cos * x + view.sin * y, view.cos * y - view.sin * x
    if ahead < -0.2 or abs(left) > 0.6 * max(ahead, 0.0) + 0.35:
        return
    cos, sin = math.cos(dog.body.angle), math.sin(dog.body.angle)
    draw_shadow(image, view, dog.x, dog.y, 0.14)
    # The position of the lens in the dog's frame determines the visible faces.
    eye = np.array([-cos * x - sin * y, sin * x - cos * y, LENS_HEIGHT_M])
    towards = eye - mesh.centres[: mesh.count]
    is_visible = (towards * mesh.normals[: mesh.count]).sum(axis=1) > 0.0
    depth = (towards * towards).sum(axis=1)
    placed = mesh.corners @ np.array([(cos, sin, 0.0), (-sin, cos, 0.0), (0.0, 0.0, 1.0)]) + (dog.x, dog.y, 0.0)
    seen = view.transform(placed)
    order = [face for face in np.argsort(-depth, kind="stable").tolist() if is_visible[face]]
    parts = [part for face in order for part in (face, *mesh.marks[face])]
    if seen[:, 0].min() < NEAR_PLANE_M:
        for part in parts:
            fill_polygon(image, seen[4 * part : 4 * part + 4].tolist(), mesh.colours[part])
        return
    for part, quad in zip(parts, project(seen).reshape(-1, 4, 2)[parts], strict=True):
        cv2.fillConvexPoly(image, quad, mesh.colours[part], cv2.LINE_AA, SUBPIXEL_BITS)


def _make_joints(width: float, height: float) -> Points:
    """Return the joints between the floor tiles as pairs of points."""
    across = [((x, 0.0, 0.0), (x, height, 0.0)) for x in np.arange(TILE_M, width - 0.01, TILE_M)]
    along = [((0.0, y, 0.0), (width, y, 0.0)) for y in np.arange(TILE_M, height - 0.01, TILE_M)]
    return np.array(across + along).reshape(-1, 3)


@dataclass(frozen=True)
class _Mesh:
    """Faces of four ``corners`` each, in the dog's frame; a face is visible from the side of its normal.

    The first ``count`` faces are drawn on their own; ``marks`` lists, for each of these, the faces painted on it.
    """

    corners: Points
    normals: Points
    centres: Points
    colours: list[Colour]
    marks: list[range]
    count: int


def _make_dog_mesh(stripes: int) -> _Mesh:
    """Build a simplified ERS-7: body, head with ``stripes`` yellow stripes, ears, legs, tail, and the shadow below."""
    faces: list[Points] = []
    plain: list[Colour] = []
    bands: list[list[Points]] = []
    for x, y, z, colour, marked in _list_boxes(stripes):
        corners = [(x[i & 1], y[i >> 1 & 1], z[i >> 2]) for i in range(8)]
        for row in _FACES:
            faces.append(np.array([corners[i] for i in row]))
            plain.append(colour)
            bands.append(_make_bands(faces[-1], marked))
    marks = []
    for some in bands:
        marks.append(range(len(faces), len(faces) + len(some)))
        faces += some
        plain += [_YELLOW] * len(some)
    quads = np.array(faces)
    normals = np.cross(quads[:, 1] - quads[:, 0], quads[:, 3] - quads[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    shades = 0.80 + 0.20 * np.clip(normals @ _LIGHT, -0.6, 1.0)
    colours = [(int(b * shade), int(g * shade), int(r * shade)) for (b, g, r), shade in zip(plain, shades, strict=True)]
    return _Mesh(quads.reshape(-1, 3), normals, quads.mean(axis=1), colours, marks, len(marks))


def _list_boxes(stripes: int) -> Iterator[tuple[Span, Span, Span, Colour, int]]:
    """Yield the boxes of a dog: spans of x, y and z in metres, the colour, and the number of stripes on each side.

    The trunk is as high as the target, so a dog in front of the target hides it completely.
    """
    yield (-0.105, 0.095), (-0.055, 0.055), (0.0, 0.11), _DARK, 0
    for x in (-0.105, 0.045):
        for y in (-0.082, 0.034):
            yield (x, x + 0.06), (y, y + 0.048), (0.0, 0.125), _GREY, 0
    yield (-0.115, 0.105), (-0.080, 0.080), (0.105, 0.232), _WHITE, 0
    yield (-0.130, -0.115), (-0.012, 0.012), (0.150, 0.240), _DARK, 0
    yield (0.035, 0.145), (-0.058, 0.058), (0.185, 0.300), _WHITE, stripes
    yield (0.145, 0.172), (-0.030, 0.030), (0.190, 0.226), _DARK, 0
    for y in (-0.072, 0.058):
        yield (0.045, 0.085), (y, y + 0.014), (0.215, 0.295), _DARK, 0


def _make_bands(face: Points, stripes: int) -> list[Points]:
    """Return ``stripes`` upright bands across a face, in its plane."""
    a, b, c, d = face
    edges = np.arange(1, 2 * stripes + 1) / (2 * stripes + 1)
    return [
        np.array([a + left * (b - a), a + right * (b - a), d + right * (c - d), d + left * (c - d)])
        for left, right in zip(edges[::2], edges[1::2], strict=True)
    ]
