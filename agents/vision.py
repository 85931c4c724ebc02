"""Find the red target in a camera picture.

This is the only module of the package that needs OpenCV (extra ``[vision]``); it is imported on demand. In YCrCb, the
colour space of the ERS-7's camera, red occupies one corner, so one range selects it; hue would need two ranges.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from agents.motion import ERS7_FIELD_OF_VIEW_RAD
from formats.jpeg import read_size

cv2.setNumThreads(1)

RED_LOW, RED_HIGH = (20, 165, 40), (240, 255, 135)
GREY_CR = 128.0
BLUR_MARGIN_PX = 2
MIN_AREA_PX = 14
MAX_SHAPE_DIFFERENCE = 0.2
MAX_DETECTION_SIDE_PX = 1024
"""Pixels per side that are sufficient for detection."""


@dataclass(frozen=True)
class TargetSize:
    """The size of the target in metres: an upright cylinder."""

    radius: float
    height: float


@dataclass(frozen=True)
class Detection:
    """The target in one picture: ``bearing`` in radians (left positive), ``distance`` in metres from camera to axis.

    ``is_whole`` is False if the blob is cut off by the picture's edge or partly hidden, so that its size is less
    reliable.  If ``is_filling``, the target spans the whole width of the picture, and the distance is only an upper
    bound.
    """

    bearing: float
    distance: float
    is_whole: bool
    is_filling: bool = False


def find_target(
    jpeg: bytes, size: TargetSize, lens: tuple[float, float | None] = ERS7_FIELD_OF_VIEW_RAD
) -> Detection | None:
    """Return the largest red blob of a JPEG picture; None if there is no blob, or the picture is invalid or too large.

    ``lens`` is the horizontal and vertical field of view in radians (vertical None: square pixels).
    """
    sides = read_size(jpeg)
    picture = None if sides is None else cv2.imdecode(np.frombuffer(jpeg, np.uint8), _select_decoding_mode(max(sides)))
    if picture is None:
        return None
    colours = cv2.cvtColor(picture, cv2.COLOR_BGR2YCrCb)
    count, _, stats, centres = cv2.connectedComponentsWithStats(cv2.inRange(colours, RED_LOW, RED_HIGH), connectivity=8)
    if count < 2:
        return None
    best = 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA]))
    left, top, width, height, area = (int(v) for v in stats[best])
    if area < MIN_AREA_PX:
        return None
    rows, columns = colours.shape[:2]
    focal_x = columns / 2 / math.tan(lens[0] / 2)
    focal_y = focal_x if lens[1] is None else rows / 2 / math.tan(lens[1] / 2)
    bearing = math.atan2(columns / 2 - (float(centres[best][0]) + 0.5), focal_x)
    around = (
        slice(max(0, top - BLUR_MARGIN_PX), top + height + BLUR_MARGIN_PX),
        slice(max(0, left - BLUR_MARGIN_PX), left + width + BLUR_MARGIN_PX),
    )
    across, up = _measure_extent(colours[around][:, :, 1].astype(np.float32))
    by_width = focal_x * 2 * size.radius / across
    by_height = focal_y * size.height / up
    is_whole = left > 0 and left + width < columns and abs(by_width / by_height - 1) < MAX_SHAPE_DIFFERENCE
    # An obstacle makes the target look smaller, never larger: the smaller distance is more reliable.
    distance = by_width if is_whole else min(by_width, by_height)
    is_filling = left == 0 and width == columns
    return Detection(bearing, distance / max(math.cos(bearing), 0.5), is_whole, is_filling)


def _select_decoding_mode(side: int) -> int:
    """Return the decoding mode for a picture with ``side`` pixels: large ones are reduced by 2 or 4."""
    if side <= MAX_DETECTION_SIDE_PX:
        return cv2.IMREAD_COLOR
    return cv2.IMREAD_REDUCED_COLOR_2 if side <= 2 * MAX_DETECTION_SIDE_PX else cv2.IMREAD_REDUCED_COLOR_4


def _measure_extent(redness: npt.NDArray[np.float32]) -> tuple[float, float]:
    """Return the width and height in pixels, with subpixel accuracy, of the blob in ``redness`` (Cr).

    JPEG stores colour at half the resolution, so edges are soft: each pixel is weighted by its redness, from grey to
    the blob's own red.
    """
    share = np.clip((redness - GREY_CR) / max(float(np.percentile(redness, 90)) - GREY_CR, 1.0), 0.0, 1.0)
    share[share < 0.1] = 0.0
    across, up = share.sum(axis=1), share.sum(axis=0)
    return max(float(np.percentile(across, 75)), 1.0), max(float(np.percentile(up, 75)), 1.0)
