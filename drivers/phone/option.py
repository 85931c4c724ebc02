"""Options of the kind "phone": the features that its browser reported."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated

from msgspec import Meta

from drivers.option import convert_options
from drivers.reading import Description
from formats.convert import Unit

FIELD_OF_VIEW_DEG = 65.0
"""Assumed field of view across the longer side of the picture, which no browser reports; phones have 60 to 75
degrees."""
MIN_SIDE_PX, MAX_SIDE_PX = 16, 640
"""Minimum and maximum width and height of a picture, in pixels."""
Side = Annotated[int, Meta(ge=MIN_SIDE_PX, le=MAX_SIDE_PX), Unit("pixels")]
TASK_FPS = 10.0
"""Pictures per second that are requested from a phone with a task."""


@dataclass(frozen=True)
class Options:
    """The size of the pictures in pixels, and whether the phone reports its orientation and position."""

    width: Side = 208
    height: Side = 156
    orientation: bool = False
    position: bool = False


def parse_options(table: Mapping[str, object]) -> Options:
    """Convert and check ``table``; raise ``UsageError`` with the key, the problem and the remedy."""
    return convert_options("phone", table, Options)


def make_description(options: Options) -> Description:
    """Return the description of the phone, which has no motors and therefore no actions."""
    lens = "fov_h_deg" if options.width >= options.height else "fov_v_deg"
    camera = {"width": options.width, "height": options.height, "fps": TASK_FPS, lens: FIELD_OF_VIEW_DEG}
    capabilities: dict[str, Mapping[str, float | str]] = {"camera": camera}
    if options.orientation:
        capabilities["orientation"] = {}
    if options.position:
        capabilities["position"] = {}
    return Description("phone", "a phone's browser", capabilities, {}, 0.08, {"camera": TASK_FPS})
