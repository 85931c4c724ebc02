"""Render the cameras of a crowd: walls, the red target, and the other robots as grey cylinders."""

from __future__ import annotations

import math
from random import Random

import cv2
import numpy as np

from sim.robots.crowd.crowd import Crowd
from sim.robots.crowd.scene import Floats
from sim.robots.rendering import (
    FOCAL_X_PIXELS,
    FOCAL_Y_PIXELS,
    HEIGHT,
    LENS_HEIGHT_M,
    NEAR_PLANE_M,
    WIDTH,
    CameraFrame,
    Colour,
    Image,
    Room,
    draw_target,
    encode_jpeg,
)
from sim.robots.scene import FOOTPRINT_RADIUS_M

CLEAR_M = 4.0
"""Distance in metres within which other robots are drawn; farther robots are drawn only if they may hide the target."""
FARTHEST_M = 12.0
WEDGE, SIDE = 0.6, 0.35
"""Maximum lateral distance of objects in the picture: this fraction of the distance ahead, plus this many metres."""
_SEAMS = np.array([1.0, 0.55, -0.35, -1.0])
_GREYS: tuple[Colour, ...] = ((118, 114, 108), (172, 168, 162), (138, 134, 128))
_STEEPEST = 1.4
_MIDDLE = WIDTH / 2 - 0.5, HEIGHT / 2 - 0.5


class CrowdCameras:
    """The cameras of the robots of ``crowd``; ``rng`` generates their noise."""

    def __init__(self, rng: Random, crowd: Crowd) -> None:
        self._crowd = crowd
        self._room = Room(rng, crowd.scene.width, crowd.scene.height, crowd.scene.wall_height)

    def render_jpeg(self, number: int, is_halved: bool = False) -> bytes:
        """Return the picture of the robot ``number`` as a JPEG, 208x160 pixels, or 104x80 if ``is_halved``."""
        return encode_jpeg(self.render_image(number), is_halved)

    def render_image(self, number: int) -> Image:
        """Return the picture as blue, green and red bytes."""
        crowd = self._crowd
        view = CameraFrame(float(crowd.x[number]), float(crowd.y[number]), float(crowd.heading[number]))
        image = self._room.draw_floor()
        self._room.draw_walls(image, view)
        target, target_at, far = crowd.target, math.inf, CLEAR_M
        if target is not None:
            ahead, left, _ = view.transform_point(target.x, target.y, LENS_HEIGHT_M)
            target_at = math.hypot(ahead, left)
            if ahead > 0.0 and abs(left) < WEDGE * ahead + SIDE:
                far = min(max(CLEAR_M, target_at), FARTHEST_M)
        others, cylinders = self._find_visible(number, view, far)
        behind = int((others > target_at).sum())
        _draw(image, cylinders[:behind])
        if target is not None:
            draw_target(image, view, target.x, target.y, target.radius, target.height)
        _draw(image, cylinders[behind:])
        return self._room.add_noise(image)

    def _find_visible(self, number: int, view: CameraFrame, far: float) -> tuple[Floats, list[list[int]]]:
        """Return the distances of the robots in view, farthest first, with the columns and lowest row of their strips.

        The cylinders are as high as the lens, so their tops are never visible.
        """
        crowd = self._crowd
        dx, dy = crowd.x - view.x, crowd.y - view.y
        ahead, left = view.cos * dx + view.sin * dy, view.cos * dy - view.sin * dx
        is_seen = (ahead > 0.0) & (ahead < far) & (np.abs(left) < WEDGE * ahead + SIDE)
        is_seen[number] = False
        seen = np.flatnonzero(is_seen)
        ahead, left = ahead[seen], left[seen]
        distance = np.hypot(ahead, left)
        order = np.argsort(-distance, kind="stable")
        ahead, left, distance = ahead[order], left[order], np.maximum(distance[order], 1e-6)
        bearing, half = np.arctan2(left, ahead), np.arcsin(np.minimum(FOOTPRINT_RADIUS_M / distance, 0.999))
        edges = np.clip(bearing[:, None] + half[:, None] * _SEAMS, -_STEEPEST, _STEEPEST)
        front = np.maximum((distance - FOOTPRINT_RADIUS_M) * np.cos(bearing), NEAR_PLANE_M)
        columns, lowest = (
            _MIDDLE[0] - FOCAL_X_PIXELS * np.tan(edges),
            _MIDDLE[1] + FOCAL_Y_PIXELS * LENS_HEIGHT_M / front,
        )
        strips: list[list[int]] = np.concatenate((columns, lowest[:, None]), axis=1).round().astype(np.int32).tolist()
        return distance, strips


def _draw(image: Image, cylinders: list[list[int]]) -> None:
    for *columns, lowest in cylinders:
        for left, right, colour in zip(columns, columns[1:], _GREYS, strict=False):
            cv2.rectangle(image, (left, HEIGHT // 2), (right, lowest), colour, cv2.FILLED)
