"""Options of the kind "camera": a camera, or a substitute source of pictures."""

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
from formats.convert import PRINTABLE, Unit

MIN_SIDE_PX, MAX_SIDE_PX = 16, 1920
"""Minimum and maximum width and height of a picture, in pixels."""
Side = Annotated[int, Meta(ge=MIN_SIDE_PX, le=MAX_SIDE_PX), Unit("pixels")]
DEVICE_PREFIX = "/dev/video"


@dataclass(frozen=True)
class StreamAddress:
    """Address of the pictures of a camera on the network; ``login`` is ``NAME:PASSWORD``, or empty."""

    host: str
    port: int
    path: str
    login: str = ""

    @property
    def name(self) -> str:
        """Host and port as text."""
        return f"[{self.host}]:{self.port}" if ":" in self.host else f"{self.host}:{self.port}"


@dataclass(frozen=True)
class Options:
    """The source of the pictures and their properties.

    ``source`` is the number of a camera or its device file, a video file, or a folder of JPEGs; alternatively, ``url``
    is the address of an MJPEG stream.  Pictures of a camera are requested in ``width`` and ``height``, and reduced to
    that size; other pictures are used unchanged.  ``lens`` is the horizontal field of view in degrees, ``quality`` the
    quality of the JPEGs, ``ahead`` the distance of the camera from the centre of its robot, in metres.
    """

    source: Annotated[
        Annotated[int, Meta(ge=0, le=63)] | Annotated[str, Meta(min_length=1)],
        Meta(description='a number from 0 to 63 ("/dev/video0" is 0), a video file, or a folder of JPEGs'),
        PRINTABLE,
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
        """Whether the source is a camera of this machine."""
        return not self.url and (isinstance(self.source, int) or self.source.startswith(DEVICE_PREFIX))


def parse_options(table: Mapping[str, object]) -> Options:
    """Convert and check ``table``; raise ``UsageError`` with the key, the problem and the remedy."""
    if "url" in table and "source" in table:
        raise UsageError('driver "camera": options source and url exclude each other; leave one out')
    if "url" in table:
        parse_url(table["url"])
    return convert_options("camera", table, Options)


def parse_url(url: object) -> StreamAddress:
    """Parse ``url``; raise ``UsageError`` with the remedy if it is invalid."""
    # The error does not contain the url, which may include a password.
    fault = UsageError('driver "camera": option url must be as in url = "http://192.168.1.30:81/stream"')
    if not isinstance(url, str) or not url.isascii() or not url.isprintable() or " " in url or len(url) > 500:
        raise fault
    try:
        parts = urlsplit(url)
        port = parts.port
    except ValueError:
        raise fault from None
    if parts.scheme == "https":
        raise UsageError('driver "camera": option url is https, which is not supported; use http')
    if parts.scheme != "http" or not parts.hostname or port == 0:
        raise fault
    login = f"{unquote(parts.username or '')}:{unquote(parts.password or '')}" if "@" in parts.netloc else ""
    path = (parts.path or "/") + (f"?{parts.query}" if parts.query else "")
    return StreamAddress(parts.hostname, port or 80, path, login)


def make_description(options: Options) -> Description:
    """Return the description of the camera, which has no motors and therefore no actions."""
    camera = {"width": options.width, "height": options.height, "fps": options.fps, "fov_h_deg": options.lens}
    camera["ahead"] = options.ahead
    model = "a camera" if options.is_device else "pictures in place of a camera"
    model = "a camera on the network" if options.url else model
    return Description("camera", model, {"camera": camera}, {}, options.radius, {"camera": options.fps})
