"""Draw the map of the simulator as a PNG, in the style of Figures 5.3 to 5.7 of the thesis."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sim.robots.rendering import Colour, Image

WIDTH, HEIGHT = 640, 520
_OVERSAMPLING = 3
"""Oversampling factor: the drawing is made larger by this factor and then reduced, for smooth edges."""
_MARGIN = 26
_CAPTION = 40
_FLOOR: Colour = (146, 172, 158)
_JOINT: Colour = (134, 160, 146)
_PAPER: Colour = (246, 245, 243)
_WALL: Colour = (96, 92, 88)
_EDGE: Colour = (70, 66, 62)
_BODY: Colour = (240, 240, 238)
_LEG: Colour = (176, 172, 168)
_EAR: Colour = (60, 56, 54)
_YELLOW: Colour = (20, 200, 250)
_RED: Colour = (40, 34, 208)
_INK: Colour = (48, 44, 42)
_FONT = cv2.FONT_HERSHEY_SIMPLEX


def draw_map(snapshot: Mapping[str, Any], caption: str = "") -> bytes:
    """Return a PNG of ``snapshot``, with a ``caption``."""
    sheet = _Canvas(snapshot["walls"], caption)
    sheet.draw_world()
    if snapshot["target"] is not None:
        sheet.draw_target(snapshot["target"])
    for dog in snapshot["dogs"]:
        sheet.draw_dog(dog)
    image = sheet.shrink()
    for dog in snapshot["dogs"]:
        _draw_name(image, sheet, dog)
    if caption:
        _draw_caption(image, caption)
    done, data = cv2.imencode(".png", image)
    if not done:
        raise RuntimeError("OpenCV cannot encode the picture")
    return data.tobytes()


class _Canvas:
    """A large drawing in metres: x to the right, y up."""

    def __init__(self, walls: Sequence[float], caption: str) -> None:
        self.room = (float(walls[0]), float(walls[1]))
        high = HEIGHT - (_CAPTION if caption else 0)
        self.scale = min((WIDTH - 2 * _MARGIN) / self.room[0], (high - 2 * _MARGIN) / self.room[1])
        self._left = (WIDTH - self.scale * self.room[0]) / 2
        self._bottom = (high + self.scale * self.room[1]) / 2
        self._image: Image = np.full((HEIGHT * _OVERSAMPLING, WIDTH * _OVERSAMPLING, 3), _PAPER, np.uint8)

    def to_picture(self, x: float, y: float) -> tuple[float, float]:
        """Return the position of a point in pixels of the finished picture."""
        return self._left + self.scale * x, self._bottom - self.scale * y

    def shrink(self) -> Image:
        return np.asarray(cv2.resize(self._image, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA), dtype=np.uint8)

    def draw_world(self) -> None:
        width, height = self.room
        thick = 0.05
        shade = [(0.03, -0.08), (width + 0.08, -0.08), (width + 0.08, height - 0.03), (0.03, height - 0.03)]
        self._draw_polygon(shade, (222, 220, 216))
        outer = [(-thick, -thick), (width + thick, -thick), (width + thick, height + thick), (-thick, height + thick)]
        self._draw_polygon(outer, _WALL)
        self._draw_polygon([(0, 0), (width, 0), (width, height), (0, height)], _FLOOR)
        for x in np.arange(0.3, width - 0.01, 0.3):
            self._draw_line([(x, 0), (x, height)], _JOINT, 0.006)
        for y in np.arange(0.3, height - 0.01, 0.3):
            self._draw_line([(0, y), (width, y)], _JOINT, 0.006)
        self._draw_line([(0, 0), (width, 0), (width, height), (0, height), (0, 0)], _EDGE, 0.012)

    def draw_target(self, target: Mapping[str, float]) -> None:
        x, y, radius = target["x"], target["y"], target["radius"]
        self._draw_disc(x + 0.02, y - 0.025, radius * 1.08, (118, 142, 130))
        self._draw_disc(x, y, radius, (30, 24, 150))
        self._draw_disc(x, y, radius * 0.90, _RED)
        self._draw_disc(x - radius * 0.3, y + radius * 0.3, radius * 0.26, (120, 112, 240))

    def draw_dog(self, dog: Mapping[str, Any]) -> None:
        x, y, heading = dog["x"], dog["y"], dog["heading"]
        cos, sin = math.cos(heading), math.sin(heading)

        def at(points: Sequence[tuple[float, float]], lift: float = 0.0) -> list[tuple[float, float]]:
            return [(x + cos * a - sin * b + lift, y + sin * a + cos * b - lift) for a, b in points]

        self._draw_polygon(at(_make_rounded_rectangle(-0.13, 0.15, -0.085, 0.085, 0.06), 0.02), (118, 142, 130))
        for a in (-0.085, 0.065):
            for b in (-0.085, 0.085):
                self._draw_outlined(at(_make_rounded_rectangle(a - 0.03, a + 0.035, b - 0.022, b + 0.022, 0.02)), _LEG)
        self._draw_line(at([(-0.11, 0.0), (-0.165, 0.0)]), _EAR, 0.02)
        self._draw_outlined(at(_make_rounded_rectangle(-0.12, 0.09, -0.068, 0.068, 0.045)), _BODY)
        self._draw_polygon(at(_make_rounded_rectangle(-0.085, 0.02, -0.026, 0.026, 0.02)), (206, 204, 200))
        for b in (-0.062, 0.062):
            self._draw_outlined(at(_make_rounded_rectangle(0.055, 0.105, b - 0.016, b + 0.016, 0.014)), _EAR)
        self._draw_outlined(at(_make_rounded_rectangle(0.15, 0.195, -0.028, 0.028, 0.02)), _EAR)
        self._draw_outlined(at(_make_rounded_rectangle(0.03, 0.16, -0.056, 0.056, 0.03)), _BODY)
        stripes = int(dog["stripes"])
        for number in range(stripes):
            middle = 0.095 + 0.036 * (number - (stripes - 1) / 2)
            left, right = middle - 0.010, middle + 0.010
            self._draw_polygon(at([(left, -0.050), (right, -0.050), (right, 0.050), (left, 0.050)]), _YELLOW)

    def _draw_outlined(self, points: Sequence[tuple[float, float]], colour: Colour) -> None:
        self._draw_polygon(points, colour)
        self._draw_line([*points, points[0]], _EDGE, 0.006)

    def _draw_polygon(self, points: Sequence[tuple[float, float]], colour: Colour) -> None:
        cv2.fillPoly(self._image, [self._to_pixels(points)], colour, cv2.LINE_AA, 4)

    def _draw_line(self, points: Sequence[tuple[float, float]], colour: Colour, thickness: float) -> None:
        wide = max(1, round(thickness * self.scale * _OVERSAMPLING))
        cv2.polylines(self._image, [self._to_pixels(points)], False, colour, wide, cv2.LINE_AA, 4)

    def _draw_disc(self, x: float, y: float, radius: float, colour: Colour) -> None:
        column, row = self._to_pixels([(x, y)])[0]
        size = round(radius * self.scale * _OVERSAMPLING * 16)
        cv2.circle(self._image, (int(column), int(row)), size, colour, -1, cv2.LINE_AA, 4)

    def _to_pixels(self, points: Sequence[tuple[float, float]]) -> NDArray[np.int32]:
        return (np.array([self.to_picture(x, y) for x, y in points]) * (_OVERSAMPLING * 16)).round().astype(np.int32)


def _make_rounded_rectangle(x1: float, x2: float, y1: float, y2: float, radius: float) -> list[tuple[float, float]]:
    points = []
    for number, (x, y) in enumerate(
        ((x2 - radius, y2 - radius), (x1 + radius, y2 - radius), (x1 + radius, y1 + radius), (x2 - radius, y1 + radius))
    ):
        for step in range(7):
            turn = (number + step / 6) * math.pi / 2
            points.append((x + radius * math.cos(turn), y + radius * math.sin(turn)))
    return points


def _draw_name(image: Image, sheet: _Canvas, dog: Mapping[str, Any]) -> None:
    """Write the name above the dog, or below it near the upper edge."""
    name, size = str(dog["name"]), 0.45
    (wide, high), _ = cv2.getTextSize(name, _FONT, size, 1)
    x, y = sheet.to_picture(dog["x"], dog["y"])
    above = y - 0.21 * sheet.scale
    base = above if above - high > sheet.to_picture(0.0, sheet.room[1])[1] + 2 else y + 0.21 * sheet.scale + high
    left, right = sheet.to_picture(0.0, 0.0)[0] + 3, sheet.to_picture(sheet.room[0], 0.0)[0] - wide - 3
    spot = (round(min(max(x - wide / 2, left), right)), round(base))
    cv2.putText(image, name, spot, _FONT, size, _FLOOR, 4, cv2.LINE_AA)
    cv2.putText(image, name, spot, _FONT, size, _INK, 1, cv2.LINE_AA)


def _draw_caption(image: Image, caption: str) -> None:
    """Write the caption at the bottom, centred, in smaller letters if it is too long."""
    width, size = image.shape[1], 0.55
    (wide, _), _ = cv2.getTextSize(caption, _FONT, size, 1)
    if wide > width - 20:
        size *= (width - 20) / wide
        (wide, _), _ = cv2.getTextSize(caption, _FONT, size, 1)
    cv2.putText(image, caption, ((width - wide) // 2, image.shape[0] - 18), _FONT, size, _INK, 1, cv2.LINE_AA)
