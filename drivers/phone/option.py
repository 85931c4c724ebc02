"""Options of the kind "phone": what its browser said that the phone has, checked."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated

from msgspec import Meta

from drivers.option import convert_options
from drivers.reading import Description
from formats.convert import Unit

LENS_DEG = 65.0
"""Across the longer side of the picture.  No browser tells it; those of phones are from 60 to 75."""
LEAST_SIDE, MOST_SIDE = 16, 640
"""Pixels of a side of a picture."""
Side = Annotated[int, Meta(ge=LEAST_SIDE, le=MOST_SIDE), Unit("pixels")]
FPS = 10.0
"""Pictures a second that a phone is asked for while it has a task."""


@dataclass(frozen=True)
class Options:
    """The pictures' size in pixels, and whether the phone tells how it is held and where it is."""

    width: Side = 208
    height: Side = 156
    orientation: bool = False
    position: bool = False


def checked(table: Mapping[str, object]) -> Options:
    """The options in ``table``; raises ``UsageError`` that names the key and what to write instead."""
    return convert_options("phone", table, Options)


def described(options: Options) -> Description:
    """What the phone is; it has no motor, so there is nothing that it can be told to do."""
    lens = "fov_h_deg" if options.width >= options.height else "fov_v_deg"
    camera = {"width": options.width, "height": options.height, "fps": FPS, lens: LENS_DEG}
    capabilities: dict[str, Mapping[str, float | str]] = {"camera": camera}
    if options.orientation:
        capabilities["orientation"] = {}
    if options.position:
        capabilities["position"] = {}
    return Description("phone", "a phone's browser", capabilities, {}, 0.08, {"camera": FPS})
