"""Options of the kind "camera": which camera, or which pictures in its place; checked."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated
from urllib.parse import unquote, urlsplit

from msgspec import Meta

from drivers.driver import MAX_FPS
from drivers.errors import UsageError
from drivers.option import convert_options
from drivers.reading import Description
from formats.convert import LINE, Unit

LEAST_SIDE, MOST_SIDE = 16, 1920
"""Pixels of a side of a picture."""
Side = Annotated[int, Meta(ge=LEAST_SIDE, le=MOST_SIDE), Unit("pixels")]
DEVICE = "/dev/video"


@dataclass(frozen=True)
class Place:
    """Where a camera on the network serves its pictures; ``login`` is ``NAME:PASSWORD``, or empty."""

    host: str
    port: int
    path: str
    login: str = ""

    @property
    def name(self) -> str:
        """Host and port as people write them."""
        return f"[{self.host}]:{self.port}" if ":" in self.host else f"{self.host}:{self.port}"


@dataclass(frozen=True)
class Options:
    """Where the pictures come from, and what they are.

    ``source`` is the number of a camera or its device file, a video file, or a folder of JPEGs; instead of it,
    ``url`` is where a camera on the network serves MJPEG.  Pictures of a camera are asked for in ``width`` and
    ``height``, and reduced to that; those of a folder and of a ``url`` are taken as they are.
    ``lens`` is across the picture in degrees, ``quality`` that of the JPEGs, ``ahead`` how far it sits before the
    middle of the robot that carries it, in metres.
    """

    source: Annotated[
        Annotated[int, Meta(ge=0, le=63)] | Annotated[str, Meta(min_length=1)],
        Meta(description='a number from 0 to 63 ("/dev/video0" is 0), a video file, or a folder of JPEGs'),
        LINE,
    ] = 0
    url: str = ""
    width: Side = 320
    height: Side = 240
    fps: Annotated[float, Meta(ge=0.1, le=MAX_FPS), Unit("pictures a second")] = 10.0
    lens: Annotated[float, Meta(ge=5, le=180), Unit("degrees across the picture")] = 60.0
    quality: Annotated[int, Meta(ge=10, le=95)] = 80
    radius: Annotated[float, Meta(ge=0.01, le=5), Unit("metres")] = 0.15
    ahead: Annotated[float, Meta(ge=-5, le=5), Unit("metres before the middle of the robot")] = 0.1

    @property
    def is_device(self) -> bool:
        """Whether it is a camera, and not files in its place."""
        return not self.url and (isinstance(self.source, int) or self.source.startswith(DEVICE))


def checked(table: Mapping[str, object]) -> Options:
    """The options in ``table``; raises ``UsageError`` that names the key and what to write instead."""
    if "url" in table and "source" in table:
        raise UsageError('driver "camera": options source and url exclude each other; leave one out')
    if "url" in table:
        place_of(table["url"])
    return convert_options("camera", table, Options)


def place_of(url: object) -> Place:
    """Where ``url`` leads; raises ``UsageError`` with the remedy."""
    # Nothing of it is shown: it may hold a password.
    fault = UsageError('driver "camera": option url must be as in url = "http://192.168.1.30:81/stream"')
    if not isinstance(url, str) or not url.isascii() or not url.isprintable() or " " in url or len(url) > 500:
        raise fault
    try:
        parts = urlsplit(url)
        port = parts.port
    except ValueError:
        raise fault from None
    if parts.scheme == "https":
        raise UsageError('driver "camera": option url is https, which cameras\' streams are not taken from; use http')
    if parts.scheme != "http" or not parts.hostname or port == 0:
        raise fault
    login = f"{unquote(parts.username or '')}:{unquote(parts.password or '')}" if "@" in parts.netloc else ""
    path = (parts.path or "/") + (f"?{parts.query}" if parts.query else "")
    return Place(parts.hostname, port or 80, path, login)


def described(options: Options) -> Description:
    """What the camera is; it has no motor, so there is nothing that it can be told to do."""
    camera = {"width": options.width, "height": options.height, "fps": options.fps, "fov_h_deg": options.lens}
    camera["ahead"] = options.ahead
    model = "a camera" if options.is_device else "pictures in place of a camera"
    model = "a camera on the network" if options.url else model
    return Description("camera", model, {"camera": camera}, {}, options.radius, {"camera": options.fps})
