"""Projection and drawing functions shared by all simulated cameras, which are mounted at the front of a robot.

208x160 pixels, 56.9 by 45.2 degrees as on the ERS-7.
"""

from __future__ import annotations

import math
from random import Random

import cv2
import numpy as np
from numpy.typing import NDArray

from sim.robots.sensor import NOSE_M

WIDTH, HEIGHT = 208, 160
FOCAL_X_PIXELS = WIDTH / 2 / math.tan(math.radians(56.9) / 2)
FOCAL_Y_PIXELS = HEIGHT / 2 / math.tan(math.radians(45.2) / 2)
LENS_HEIGHT_M = 0.19
"""Height of the lens above the floor in metres."""
JPEG_QUALITY = 80
NEAR_PLANE_M = 0.02
SKIRTING_M = 0.03

Colour = tuple[int, int, int]
"""A colour as blue, green and red, the order of OpenCV."""
Points = NDArray[np.float64]
Image = NDArray[np.uint8]

_WALLS: tuple[Colour, ...] = ((182, 176, 166), (170, 164, 154), (188, 182, 172), (164, 158, 149))
_SKIRTING: Colour = (112, 106, 98)
_BACKGROUND: Colour = (214, 208, 202)
_SHADOW: Colour = (84, 104, 92)

_STRIP_EDGES = (1.0, 0.9, 0.72, 0.45, 0.1, -0.3, -0.62, -0.86, -1.0)
"""Boundaries between the strips of the round target, as fractions of its half width, from left to right."""
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
SUBPIXEL_BITS = 4
_NOISE_SHEETS = 8
_SCALE = (-FOCAL_X_PIXELS * (1 << SUBPIXEL_BITS), -FOCAL_Y_PIXELS * (1 << SUBPIXEL_BITS))
_MIDDLE = ((WIDTH / 2 - 0.5) * (1 << SUBPIXEL_BITS), (HEIGHT / 2 - 0.5) * (1 << SUBPIXEL_BITS))

# One thread draws a frame in less than a millisecond; more threads would only compete for the processor cores.
cv2.setNumThreads(1)


class CameraFrame:
    """Coordinates in the frame of the lens of a robot at this pose: forward, left, up."""

    def __init__(self, x: float, y: float, heading: float) -> None:
        self.cos, self.sin = math.cos(heading), math.sin(heading)
        self.x, self.y = x + NOSE_M * self.cos, y + NOSE_M * self.sin
        self._turn = np.array([(self.cos, -self.sin, 0.0), (self.sin, self.cos, 0.0), (0.0, 0.0, 1.0)])

    def transform_point(self, x: float, y: float, z: float) -> list[float]:
        """Transform one point of the world."""
        x, y = x - self.x, y - self.y
        return [self.cos * x + self.sin * y, self.cos * y - self.sin * x, z - LENS_HEIGHT_M]

    def transform(self, points: Points) -> Points:
        """Transform points of the world."""
        moved: Points = (points - (self.x, self.y, LENS_HEIGHT_M)) @ self._turn
        return moved


def project(seen: Points) -> NDArray[np.int32]:
    """Project points beyond the near plane to the picture, in sixteenths of a pixel."""
    places = np.empty((len(seen), 2))
    np.divide(seen[:, 1:], seen[:, :1], out=places)
    places *= _SCALE
    places += _MIDDLE
    return places.astype(np.int32)


def fill_polygon(image: Image, seen: list[list[float]], colour: Colour) -> None:
    """Fill a convex polygon, clipped at the near plane; with few corners, plain numbers are faster than arrays."""
    if all(corner[0] < NEAR_PLANE_M for corner in seen):
        return
    if any(corner[0] < NEAR_PLANE_M for corner in seen):
        seen = _clip_polygon(seen)
    (scale_x, scale_y), (middle_x, middle_y) = _SCALE, _MIDDLE
    places = [(int(middle_x + scale_x * y / x), int(middle_y + scale_y * z / x)) for x, y, z in seen]
    cv2.fillConvexPoly(image, np.array(places, np.int32), colour, cv2.LINE_AA, SUBPIXEL_BITS)


def _clip_polygon(seen: list[list[float]]) -> list[list[float]]:
    """Clip a convex polygon at the near plane (Sutherland-Hodgman for one plane)."""
    corners = []
    for one, other in zip(seen, seen[1:] + seen[:1], strict=True):
        if one[0] >= NEAR_PLANE_M:
            corners.append(one)
        if (one[0] >= NEAR_PLANE_M) != (other[0] >= NEAR_PLANE_M):
            share = (NEAR_PLANE_M - one[0]) / (other[0] - one[0])
            corners.append([NEAR_PLANE_M, *(a + share * (b - a) for a, b in zip(one[1:], other[1:], strict=True))])
    return corners


def draw_shadow(image: Image, view: CameraFrame, x: float, y: float, radius: float) -> None:
    """Darken the floor under a round object."""
    ring = [view.transform_point(x + radius * cos, y + radius * sin, 0.0) for cos, sin in _RING]
    fill_polygon(image, ring, _SHADOW)


def draw_target(image: Image, view: CameraFrame, x: float, y: float, radius: float, height: float) -> None:
    """Draw the upright red cylinder, at least as high as the lens, as strips between its two tangents."""
    ahead, left, _ = view.transform_point(x, y, 0.0)
    distance, bearing = math.hypot(ahead, left), math.atan2(left, ahead)
    half = math.asin(min(0.999, radius / max(distance, 1e-6)))
    if abs(bearing) - half > math.radians(35.0):
        return
    draw_shadow(image, view, x, y, radius * 1.25)
    edges = []
    for share in _STRIP_EDGES:
        off = half * share
        edge = max(-1.4, min(1.4, bearing + off))
        # The front of the cylinder is nearer than its tangents.
        sagitta = math.sqrt(max(0.0, radius**2 - (distance * math.sin(off)) ** 2))
        along = distance * math.cos(off) - sagitta
        edges.append((max(along * math.cos(edge), NEAR_PLANE_M), along * math.sin(edge)))
    for (ahead_1, left_1), (ahead_2, left_2), colour in zip(edges, edges[1:], _REDS, strict=False):
        low, high = -LENS_HEIGHT_M, height - LENS_HEIGHT_M
        strip = [[ahead_1, left_1, low], [ahead_2, left_2, low], [ahead_2, left_2, high], [ahead_1, left_1, high]]
        fill_polygon(image, strip, colour)


class Room:
    """Draws an empty room of ``width`` by ``depth`` metres, and the noise of a camera, which ``rng`` generates."""

    def __init__(self, rng: Random, width: float, depth: float, wall_height: float) -> None:
        self._rng = rng
        generator = np.random.default_rng(rng.getrandbits(64))
        self._noise = [
            np.clip(generator.normal(8.0, 3.0, (HEIGHT, WIDTH, 3)), 0, 16).astype(np.uint8)
            for _ in range(_NOISE_SHEETS)
        ]
        self._backdrop = _make_backdrop()
        corners = [(0.0, 0.0), (width, 0.0), (width, depth), (0.0, depth)]
        self._quads = np.array(
            [
                corner
                for (x1, y1), (x2, y2) in zip(corners, corners[1:] + corners[:1], strict=True)
                for high in (wall_height, SKIRTING_M)
                for corner in ((x1, y1, 0.0), (x2, y2, 0.0), (x2, y2, high), (x1, y1, high))
            ]
        )

    def draw_floor(self) -> Image:
        """Return a new picture with the floor and the background, without walls."""
        return self._backdrop.copy()

    def draw_walls(self, image: Image, view: CameraFrame) -> None:
        """Draw the four walls."""
        rows = view.transform(self._quads).tolist()
        for number in range(0, len(rows), 8):
            fill_polygon(image, rows[number : number + 4], _WALLS[number // 8])
            fill_polygon(image, rows[number + 4 : number + 8], _SKIRTING)

    def add_noise(self, image: Image) -> Image:
        """Return the picture with sensor noise."""
        return np.asarray(cv2.add(image, self._noise[self._rng.randrange(_NOISE_SHEETS)]), dtype=np.uint8)


def encode_jpeg(image: Image, is_halved: bool = False) -> bytes:
    """Encode the picture as a JPEG, optionally at half the width and height."""
    if is_halved:
        image = np.asarray(cv2.resize(image, (WIDTH // 2, HEIGHT // 2), interpolation=cv2.INTER_AREA), np.uint8)
    done, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    if not done:
        raise RuntimeError("OpenCV cannot encode the picture")
    return data.tobytes()


def _make_backdrop() -> Image:
    """Return the background: a plain area above the horizon, and the floor below, which is lighter near the lens."""
    image = np.empty((HEIGHT, WIDTH, 3), np.uint8)
    image[:] = _BACKGROUND
    ramp = np.linspace(0.0, 1.0, HEIGHT - HEIGHT // 2)[:, None]
    image[HEIGHT // 2 :] = ((1 - ramp) * (104, 130, 116) + ramp * (126, 156, 140)).astype(np.uint8)[:, None, :]
    return image
