"""Options of the simulated driver: read from a free table and checked, each fault with its remedy."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from drivers.driver import MAX_FPS
from drivers.errors import UsageError
from drivers.reading import Description

DEFAULT_PORT = 7400


@dataclass(frozen=True)
class Options:
    """Where the yard is, which of its robots is meant, and how many pictures a second are wanted (0: no camera)."""

    robot: str
    host: str = "127.0.0.1"
    port: int = DEFAULT_PORT
    camera_fps: float = 15.0
    camera: bool = True

    @property
    def wanted_fps(self) -> float:
        """Pictures a second to ask for."""
        return self.camera_fps if self.camera else 0.0


def checked(table: Mapping[str, object]) -> Options:
    """The options in ``table``; raises ``UsageError`` that names the key and what to write instead."""
    known = ("robot", "host", "port", "camera_fps", "camera")
    for key in table:
        if key not in known:
            raise UsageError(f'driver "sim": unknown option {key!r}; known are {", ".join(known)}')
    robot = table.get("robot")
    if not isinstance(robot, str) or not 1 <= len(robot) <= 32:
        raise _fault("robot", robot, 'the name of a robot of the yard, as in robot = "dog1"')
    host = table.get("host", "127.0.0.1")
    if not isinstance(host, str) or not host:
        raise _fault("host", host, 'the address of the yard, as in host = "127.0.0.1"')
    port = table.get("port", DEFAULT_PORT)
    if type(port) is not int or not 1 <= port <= 65535:
        raise _fault("port", port, f"a number from 1 to 65535, as in port = {DEFAULT_PORT}")
    fps = table.get("camera_fps", 15.0)
    if not isinstance(fps, (int, float)) or isinstance(fps, bool) or not 0 <= fps <= MAX_FPS:
        raise _fault("camera_fps", fps, f"pictures a second from 0 to {MAX_FPS:g}, as in camera_fps = 15")
    camera = table.get("camera", True)
    if not isinstance(camera, bool):
        raise _fault("camera", camera, "true or false")
    return Options(robot, host, port, float(fps), camera)


def described(options: Options) -> Description:
    """What a dog of the yard is: an ERS-7 (Tekkotsu's walk figures and sensor ranges), known without a connection."""
    capabilities: dict[str, Mapping[str, float | str]] = {
        "base2d": {},
        "odometry": {},
        "compass": {},
        "ranger": {"max": 1.5},
        "imu": {},
        "power": {},
    }
    rates = {"state": 31.25}
    if options.wanted_fps > 0:
        capabilities["camera"] = {"width": 208, "height": 160, "fps": 30, "fov_h_deg": 56.9, "fov_v_deg": 45.2}
        rates["camera"] = options.wanted_fps
    return Description(
        kind="aibo-ers7",
        model="ERS-7 (simulated)",
        capabilities=capabilities,
        limits={"base.vx": (-0.156, 0.160), "base.vy": (-0.103, 0.103), "base.wz": (-2.03, 2.03)},
        radius=0.12,
        rates=rates,
    )


def _fault(key: str, value: object, remedy: str) -> UsageError:
    return UsageError(f'driver "sim": option {key} is {value!r}, but must be {remedy}')
