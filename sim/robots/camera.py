"""Camera: what a dog sees, painted far to near from the world alone; 208x160, 56.9 by 45.2 degrees as on the ERS-7."""

from __future__ import annotations

import math
from random import Random

import cv2
import numpy as np

from sim.robots.dog import Dog
from sim.robots.lens import (
    EYE,
    NEAR_PLANE,
    SUB_BITS,
    Image,
    Room,
    View,
    draw_cylinder,
    draw_shadow,
    encoded,
    filled,
    pixels,
)
from sim.robots.mesh import Colour, Mesh, Points, dog_mesh
from sim.robots.world import Target, World

TILE = 0.3
_JOINT: Colour = (96, 118, 106)


class Camera:
    """Draws for every dog of ``world``; the noise comes from ``rng``, so a seed gives the same pictures."""

    def __init__(self, rng: Random, world: World) -> None:
        self._world = world
        self._room = Room(rng, world.scene.width, world.scene.height, world.scene.wall_height)
        self._meshes = {name: dog_mesh(dog.stripes) for name, dog in world.dogs.items()}
        self._joints = _joints(world.scene.width, world.scene.height)

    def jpeg(self, dog: Dog, is_halved: bool = False) -> bytes:
        """The picture as a JPEG, with half the width and height if asked for."""
        return encoded(self.image(dog), is_halved)

    def image(self, dog: Dog) -> Image:
        """The picture as blue, green and red bytes, sensor noise included."""
        view = View(dog.x, dog.y, dog.body.angle)
        image = self._room.floor()
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
                draw_cylinder(image, view, thing.x, thing.y, thing.radius, thing.height)
            else:
                _draw_dog(image, view, thing, self._meshes[thing.name])
        return self._room.noisy(image)

    def _draw_joints(self, image: Image, view: View) -> None:
        seen = view.seen(self._joints).reshape(-1, 2, 3)
        ahead = seen[:, :, 0]
        seen = seen[ahead.max(axis=1) > NEAR_PLANE]
        one, other = seen[:, 0], seen[:, 1]
        for end, opposite in ((one, other), (other, one)):
            behind = end[:, 0] < NEAR_PLANE
            if behind.any():
                start, stop = end[behind], opposite[behind]
                share = (NEAR_PLANE - start[:, 0]) / (stop[:, 0] - start[:, 0])
                end[behind] = start + share[:, None] * (stop - start)
        lines = pixels(seen.reshape(-1, 3)).reshape(-1, 2, 2)
        cv2.polylines(image, list(lines), False, _JOINT, 1, cv2.LINE_AA, SUB_BITS)


def _draw_dog(image: Image, view: View, dog: Dog, mesh: Mesh) -> None:
    x, y = dog.x - view.x, dog.y - view.y
    ahead, left = view.cos * x + view.sin * y, view.cos * y - view.sin * x
    if ahead < -0.2 or abs(left) > 0.6 * max(ahead, 0.0) + 0.35:
        return
    cos, sin = math.cos(dog.body.angle), math.sin(dog.body.angle)
    draw_shadow(image, view, dog.x, dog.y, 0.14)
    # The eye in the dog's own frame says which faces look towards it.
    eye = np.array([-cos * x - sin * y, sin * x - cos * y, EYE])
    towards = eye - mesh.centres[: mesh.count]
    looks = (towards * mesh.normals[: mesh.count]).sum(axis=1) > 0.0
    depth = (towards * towards).sum(axis=1)
    placed = mesh.corners @ np.array([(cos, sin, 0.0), (-sin, cos, 0.0), (0.0, 0.0, 1.0)]) + (dog.x, dog.y, 0.0)
    seen = view.seen(placed)
    order = [face for face in np.argsort(-depth, kind="stable").tolist() if looks[face]]
    parts = [part for face in order for part in (face, *mesh.marks[face])]
    if seen[:, 0].min() < NEAR_PLANE:
        for part in parts:
            filled(image, seen[mesh.quads[part]].tolist(), mesh.colours[part])
        return
    for part, quad in zip(parts, pixels(seen)[mesh.quads[parts]], strict=True):
        cv2.fillConvexPoly(image, quad, mesh.colours[part], cv2.LINE_AA, SUB_BITS)


def _joints(width: float, height: float) -> Points:
    """The joints between the floor tiles as pairs of points."""
    across = [((x, 0.0, 0.0), (x, height, 0.0)) for x in np.arange(TILE, width - 0.01, TILE)]
    along = [((0.0, y, 0.0), (width, y, 0.0)) for y in np.arange(TILE, height - 0.01, TILE)]
    return np.array(across + along).reshape(-1, 3)
