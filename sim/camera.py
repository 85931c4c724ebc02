"""Camera: what a dog sees, painted far to near from the world alone; 208x160, 56.9 by 45.2 degrees as on the ERS-7."""

from __future__ import annotations

import math
from random import Random

import cv2
import numpy as np
from numpy.typing import NDArray

from sim.dog import Dog
from sim.mesh import Colour, Mesh, Points, dog_mesh
from sim.sensor import NOSE
from sim.world import Target, World

WIDTH, HEIGHT = 208, 160
FOCAL_X = WIDTH / 2 / math.tan(math.radians(56.9) / 2)
FOCAL_Y = HEIGHT / 2 / math.tan(math.radians(45.2) / 2)
EYE = 0.19
"""Metres of the lens above the floor."""
QUALITY = 80
NEAR_PLANE = 0.02
TILE = 0.3
SKIRTING_M = 0.03

Image = NDArray[np.uint8]

_WALLS: tuple[Colour, ...] = ((182, 176, 166), (170, 164, 154), (188, 182, 172), (164, 158, 149))
_SKIRTING: Colour = (112, 106, 98)
_BEYOND: Colour = (214, 208, 202)
_JOINT: Colour = (96, 118, 106)
_SHADOW: Colour = (84, 104, 92)
_SEAMS = (1.0, 0.9, 0.72, 0.45, 0.1, -0.3, -0.62, -0.86, -1.0)
"""Where the strips of the round target meet, as shares of its half width, from left to right."""
_REDS: tuple[Colour, ...] = (
    (28, 18, 158),
    (32, 22, 176),
    (38, 28, 194),
    (48, 38, 212),
    (46, 36, 208),
    (40, 30, 200),
    (34, 24, 184),
    (29, 19, 164),
)
_RING = [(math.cos(turn * math.tau / 14), math.sin(turn * math.tau / 14)) for turn in range(14)]
_SUB_BITS = 4
_NOISE_SHEETS = 8
_SCALE = (-FOCAL_X * (1 << _SUB_BITS), -FOCAL_Y * (1 << _SUB_BITS))
_MIDDLE = ((WIDTH / 2 - 0.5) * (1 << _SUB_BITS), (HEIGHT / 2 - 0.5) * (1 << _SUB_BITS))

# One thread draws a frame in well under a millisecond; a pool of threads would only contend for the cores.
cv2.setNumThreads(1)


class Camera:
    """Draws for every dog of ``world``; the noise comes from ``rng``, so a seed gives the same pictures."""

    def __init__(self, rng: Random, world: World) -> None:
        self._rng = rng
        self._world = world
        dice = np.random.default_rng(rng.getrandbits(64))
        self._noise = [
            np.clip(dice.normal(8.0, 3.0, (HEIGHT, WIDTH, 3)), 0, 16).astype(np.uint8) for _ in range(_NOISE_SHEETS)
        ]
        self._meshes = {name: dog_mesh(dog.stripes) for name, dog in world.dogs.items()}
        self._backdrop = _backdrop()
        self._joints = _joints(world.scene.width, world.scene.height)
        self._quads = np.array(
            [
                corner
                for x1, y1, x2, y2 in world.walls
                for high in (world.scene.wall_height, SKIRTING_M)
                for corner in ((x1, y1, 0.0), (x2, y2, 0.0), (x2, y2, high), (x1, y1, high))
            ]
        )

    def jpeg(self, dog: Dog) -> bytes:
        """The picture as a JPEG."""
        done, data = cv2.imencode(".jpg", self.image(dog), [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
        if not done:
            raise RuntimeError("the picture cannot be encoded")
        return data.tobytes()

    def image(self, dog: Dog) -> Image:
        """The picture as blue, green and red bytes, sensor noise included."""
        view = _View(dog)
        image = self._backdrop.copy()
        self._draw_floor(image, view)
        self._draw_walls(image, view)
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
                _draw_target(image, view, thing)
            else:
                _draw_dog(image, view, thing, self._meshes[thing.name])
        sheet = self._noise[self._rng.randrange(_NOISE_SHEETS)]
        return np.asarray(cv2.add(image, sheet), dtype=np.uint8)

    def _draw_floor(self, image: Image, view: _View) -> None:
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
        pixels = _pixels(seen.reshape(-1, 3)).reshape(-1, 2, 2)
        cv2.polylines(image, list(pixels), False, _JOINT, 1, cv2.LINE_AA, _SUB_BITS)

    def _draw_walls(self, image: Image, view: _View) -> None:
        rows = view.seen(self._quads).tolist()
        for number in range(0, len(rows), 8):
            _fill(image, rows[number : number + 4], _WALLS[number // 8])
            _fill(image, rows[number + 4 : number + 8], _SKIRTING)


class _View:
    """Where the lens is, and the way from the yard's frame into its own: forward, left, up."""

    def __init__(self, dog: Dog) -> None:
        self.cos, self.sin = math.cos(dog.body.angle), math.sin(dog.body.angle)
        self.x, self.y = dog.x + NOSE * self.cos, dog.y + NOSE * self.sin
        self._turn = np.array([(self.cos, -self.sin, 0.0), (self.sin, self.cos, 0.0), (0.0, 0.0, 1.0)])

    def seen_one(self, x: float, y: float, z: float) -> list[float]:
        """One point of the yard, from the lens."""
        x, y = x - self.x, y - self.y
        return [self.cos * x + self.sin * y, self.cos * y - self.sin * x, z - EYE]

    def seen(self, points: Points) -> Points:
        """Points of the yard, from the lens."""
        moved: Points = (points - (self.x, self.y, EYE)) @ self._turn
        return moved


def _pixels(seen: Points) -> NDArray[np.int32]:
    """Where points before the near plane fall on the picture, in sixteenths of a pixel."""
    places = np.empty((len(seen), 2))
    np.divide(seen[:, 1:], seen[:, :1], out=places)
    places *= _SCALE
    places += _MIDDLE
    return places.astype(np.int32)


def _fill(image: Image, seen: list[list[float]], colour: Colour) -> None:
    """Fill a convex polygon of a few corners, clipped at the near plane; for so few, plain numbers beat arrays."""
    if all(corner[0] < NEAR_PLANE for corner in seen):
        return
    if any(corner[0] < NEAR_PLANE for corner in seen):
        seen = _clipped(seen)
    (scale_x, scale_y), (middle_x, middle_y) = _SCALE, _MIDDLE
    places = [(int(middle_x + scale_x * y / x), int(middle_y + scale_y * z / x)) for x, y, z in seen]
    cv2.fillConvexPoly(image, np.array(places, np.int32), colour, cv2.LINE_AA, _SUB_BITS)


def _clipped(seen: list[list[float]]) -> list[list[float]]:
    """What of a convex polygon lies beyond the near plane (Sutherland and Hodgman's rule for one plane)."""
    kept = []
    for one, other in zip(seen, seen[1:] + seen[:1], strict=True):
        if one[0] >= NEAR_PLANE:
            kept.append(one)
        if (one[0] >= NEAR_PLANE) != (other[0] >= NEAR_PLANE):
            share = (NEAR_PLANE - one[0]) / (other[0] - one[0])
            kept.append([NEAR_PLANE, *(a + share * (b - a) for a, b in zip(one[1:], other[1:], strict=True))])
    return kept


def _draw_dog(image: Image, view: _View, dog: Dog, mesh: Mesh) -> None:
    x, y = dog.x - view.x, dog.y - view.y
    ahead, left = view.cos * x + view.sin * y, view.cos * y - view.sin * x
    if ahead < -0.2 or abs(left) > 0.6 * max(ahead, 0.0) + 0.35:
        return
    cos, sin = math.cos(dog.body.angle), math.sin(dog.body.angle)
    _draw_shadow(image, view, dog.x, dog.y, 0.14)
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
            _fill(image, seen[mesh.quads[part]].tolist(), mesh.colours[part])
        return
    for part, quad in zip(parts, _pixels(seen)[mesh.quads[parts]], strict=True):
        cv2.fillConvexPoly(image, quad, mesh.colours[part], cv2.LINE_AA, _SUB_BITS)


def _draw_shadow(image: Image, view: _View, x: float, y: float, radius: float) -> None:
    ring = [view.seen_one(x + radius * cos, y + radius * sin, 0.0) for cos, sin in _RING]
    _fill(image, ring, _SHADOW)


def _draw_target(image: Image, view: _View, target: Target) -> None:
    """Draw the cylinder as upright strips between its two tangents; its top is above the lens and stays unseen."""
    ahead, left, _ = view.seen_one(target.x, target.y, 0.0)
    distance, bearing = math.hypot(ahead, left), math.atan2(left, ahead)
    half = math.asin(min(0.999, target.radius / max(distance, 1e-6)))
    if abs(bearing) - half > math.radians(35.0):
        return
    _draw_shadow(image, view, target.x, target.y, target.radius * 1.25)
    seams = []
    for share in _SEAMS:
        off = half * share
        edge = max(-1.4, min(1.4, bearing + off))
        # The foot and the top are round: the middle of the cylinder is nearer than its tangents.
        sagitta = math.sqrt(max(0.0, target.radius**2 - (distance * math.sin(off)) ** 2))
        along = distance * math.cos(off) - sagitta
        seams.append((max(along * math.cos(edge), NEAR_PLANE), along * math.sin(edge)))
    for (ahead_1, left_1), (ahead_2, left_2), colour in zip(seams, seams[1:], _REDS, strict=False):
        low, high = -EYE, target.height - EYE
        strip = [[ahead_1, left_1, low], [ahead_2, left_2, low], [ahead_2, left_2, high], [ahead_1, left_1, high]]
        _fill(image, strip, colour)


def _backdrop() -> Image:
    """The room beyond the walls above the horizon, the floor below it, lighter towards the lens."""
    image = np.empty((HEIGHT, WIDTH, 3), np.uint8)
    image[:] = _BEYOND
    ramp = np.linspace(0.0, 1.0, HEIGHT - HEIGHT // 2)[:, None]
    image[HEIGHT // 2 :] = ((1 - ramp) * (104, 130, 116) + ramp * (126, 156, 140)).astype(np.uint8)[:, None, :]
    return image


def _joints(width: float, height: float) -> Points:
    """The joints between the floor tiles as pairs of points."""
    across = [((x, 0.0, 0.0), (x, height, 0.0)) for x in np.arange(TILE, width - 0.01, TILE)]
    along = [((0.0, y, 0.0), (width, y, 0.0)) for y in np.arange(TILE, height - 0.01, TILE)]
    return np.array(across + along).reshape(-1, 3)
