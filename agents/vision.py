"""Vision: find the red target in a camera picture.

The only module of this room that needs OpenCV (extra ``[vision]``); it is imported when an agent that looks is made.
Red is one corner of YCrCb, the colours that the ERS-7's camera delivers, so one range finds it without a wrap-around of hue.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

cv2.setNumThreads(1)

FIELD_OF_VIEW = math.radians(56.9)
"""Horizontal, of the ERS-7's camera."""
RED_LOW, RED_HIGH = (20, 165, 40), (240, 255, 135)
MIN_AREA = 14


@dataclass(frozen=True)
class Sighting:
    """The target in one picture: ``bearing`` in radians (left positive), ``distance`` in metres from the camera to its centre.

    ``is_whole`` is false where the blob is cut off by the picture's edge or partly hidden, so that the size says less.
    """

    bearing: float
    distance: float
    is_whole: bool


def find_target(jpeg: bytes, target_radius: float) -> Sighting | None:
    """The largest red blob of a JPEG picture, or None; bytes that are no picture count as nothing seen."""
    picture = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
    if picture is None:
        return None
    mask = cv2.inRange(cv2.cvtColor(picture, cv2.COLOR_BGR2YCrCb), RED_LOW, RED_HIGH)
    count, _, stats, centres = cv2.connectedComponentsWithStats(mask, connectivity=8)
    if count < 2:
        return None
    best = 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA]))
    left, _top, width, height, area = (int(v) for v in stats[best])
    if area < MIN_AREA:
        return None
    rows, columns = mask.shape
    focal = (columns / 2) / math.tan(FIELD_OF_VIEW / 2)
    bearing = math.atan2(columns / 2 - (float(centres[best][0]) + 0.5), focal)
    is_whole = left > 0 and left + width < columns and area > 0.6 * width * height and 0.75 < width / height < 1.33
    # The area of a whole disc averages out the pixel grid; of a part of it, the longer side is the better witness.
    radius = math.sqrt(area / math.pi) if is_whole else max(width, height) / 2
    return Sighting(bearing, focal * target_radius / radius / max(math.cos(bearing), 0.5), is_whole)
