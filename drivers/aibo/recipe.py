"""Recipe: which lines main control is sent to start, set and stop the servers on the dog; pure.

The servers are called differently in each generation of Tekkotsu: each name is sent, and the dog ignores those that
it does not know.  A running server is called ``#name``, so starting it again does nothing.
"""

from __future__ import annotations

from collections.abc import Iterable

from drivers.aibo.menu import HELLO, select, setting, unselect

SERVERS: dict[str, tuple[str, ...]] = {
    "estop": ("EStop Remote Control", "EStopControllerBehavior", "EStopController"),
    "state": ("World State Serializer",),
    "walk": ("Walk Remote Control", "WalkController"),
    "head": ("Head Remote Control", "HeadController"),
    "camera": ("Raw Cam Server", "RawCam"),
}
PICTURE_MS = 1000.0 / 30.0


def greeting() -> list[str]:
    """What is asked first: who is there, and which menu is open."""
    return [HELLO, "!dump_stack", "!refresh"]


def started(services: Iterable[str], transport: str, fps: float, width: int = 104) -> list[str]:
    """Settings, then the servers, in both spellings of each; the last line's answer says that all before were read."""
    lines = [setting("main.worldState_interval", 0), setting("vision.rawcam.transport", transport.upper())]
    lines += [setting("vision.rawcam.encoding", "color"), setting("vision.rawcam.compression", "jpeg")]
    lines += sized(width) + paced(fps)
    lines += [select(name) for service in services for name in SERVERS[service]]
    return [*lines, HELLO]


def sized(width: int) -> list[str]:
    """The width of the pictures, in pixels: each layer of the camera is half as wide as the one above."""
    skip = {208: 1, 104: 2}[width]
    names = (f"vision.rawcam{mark}{channel}_skip" for mark in "._" for channel in ("y", "uv"))
    return [setting(name, skip + name.endswith("uv_skip")) for name in names]


def paced(fps: float) -> list[str]:
    """The camera's pace: the dog waits from the end of one picture on, so half a picture is taken off the wait."""
    wait_ms = 0 if fps <= 0 or fps >= 29 else round(1000.0 / fps - PICTURE_MS / 2.0)
    return [setting("vision.rawcam.interval", wait_ms), setting("vision.rawcam_interval", wait_ms)]


def stopped(services: Iterable[str]) -> list[str]:
    """What stops these servers."""
    return [unselect(name) for service in services for name in SERVERS[service]]


def sound(name: str) -> list[str]:
    """What plays a sound from the stick, under the name that its file has there."""
    return [select("Play Sound"), select(name.upper())]
