"""Options of the AIBO's driver: read from a free table and checked, each fault with its remedy."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from ipaddress import ip_address

from drivers.aibo.sense import MODEL, NOD, PAN, TILT
from drivers.driver import MAX_FPS
from drivers.errors import UsageError
from drivers.reading import Description

PORTS: dict[str, int] = {"main": 10020, "estop": 10053, "state": 10031, "walk": 10050, "head": 10052, "camera": 10011}
"""What the driver connects to, and where Tekkotsu serves it."""
FORWARD, BACKWARD, ASIDE, TURN = 0.160, 0.156, 0.103, 2.03
"""How fast the stock walk is, in m/s and rad/s."""
SOUNDS = {"howl": "5", "yap": "6", "whimper": "7", "growl": "8", "bark": "9"}
"""What the walk server plays, and the letter that has it do so."""
TRANSPORTS = ("tcp", "udp")
HEIGHTS = {104: 80, 208: 160}
"""The height of a picture of each width that the camera gives."""


@dataclass(frozen=True)
class Options:
    """Where the dog is, how its camera is brought here, how fast its walk is, and which port serves what."""

    host: str
    camera: bool = True
    camera_fps: float = 15.0
    camera_transport: str = "tcp"
    camera_width: int = 104
    speed: tuple[float, float, float, float] = (FORWARD, BACKWARD, ASIDE, TURN)
    ports: Mapping[str, int] = field(default_factory=lambda: dict(PORTS))

    @property
    def wanted_fps(self) -> float:
        """Pictures a second to ask for."""
        return self.camera_fps if self.camera else 0.0


def checked(table: Mapping[str, object]) -> Options:
    """The options in ``table``; raises ``UsageError`` that names the key and what to write instead."""
    known = ("host", "camera", "camera_fps", "camera_transport", "camera_width", "speed", "ports")
    for key in table:
        if key not in known:
            raise UsageError(f'driver "aibo": unknown option {key!r}; known are {", ".join(known)}')
    host = table.get("host")
    if not isinstance(host, str) or not host or len(host) > 253:
        raise _fault("host", host, 'the address of the dog, as in host = "192.168.0.51"')
    camera = table.get("camera", True)
    if not isinstance(camera, bool):
        raise _fault("camera", camera, "true or false")
    fps = table.get("camera_fps", 15.0)
    if not isinstance(fps, (int, float)) or isinstance(fps, bool) or not 0 <= fps <= MAX_FPS:
        raise _fault("camera_fps", fps, f"pictures a second from 0 to {MAX_FPS:g}, as in camera_fps = 15")
    transport = table.get("camera_transport", "tcp")
    if transport not in TRANSPORTS:
        raise _fault("camera_transport", transport, '"tcp" or "udp"')
    if transport == "udp" and not _is_address(host):
        raise _fault("host", host, 'a numeric address where camera_transport is "udp", as in host = "192.168.0.51"')
    width = table.get("camera_width", 104)
    if type(width) is not int or width not in HEIGHTS:
        raise _fault("camera_width", width, "104 or 208 pixels, as in camera_width = 208")
    speed = table.get("speed", (FORWARD, BACKWARD, ASIDE, TURN))
    if not isinstance(speed, (list, tuple)) or len(speed) != 4 or not all(_is_number(v) and 0 < v <= 10 for v in speed):
        raise _fault(
            "speed", speed, "forward, backward, aside (m/s) and turn (rad/s), as in [0.16, 0.156, 0.103, 2.03]"
        )
    forward, backward, aside, turn = (float(value) for value in speed)
    ports = _ports(table.get("ports", {}))
    return Options(host, camera, float(fps), str(transport), width, (forward, backward, aside, turn), ports)


def described(options: Options) -> Description:
    """What an ERS-7 is, known without a connection."""
    forward, backward, aside, turn = options.speed
    capabilities: dict[str, Mapping[str, float | str]] = {
        "base2d": {},
        "odometry": {"estimated": 1.0},
        "ranger": {"max": 1.5},
        "imu": {},
        "joints": {"count": 18.0, "read_only": 1.0},
        "ptz": {f"{name}_{end}": value for name, ends in _HEAD.items() for end, value in zip(_ENDS, ends, strict=True)},
        "buttons": {},
        "power": {},
        "sound": {},
        "estop": {},
    }
    rates = {"state": 31.25}
    if options.wanted_fps > 0:
        size = {"width": options.camera_width, "height": HEIGHTS[options.camera_width]}
        capabilities["camera"] = {**size, "fps": 30, "fov_h_deg": 56.9, "fov_v_deg": 45.2}
        rates["camera"] = options.wanted_fps
    return Description(
        kind="aibo-ers7",
        model=MODEL,
        capabilities=capabilities,
        limits={"base.vx": (-backward, forward), "base.vy": (-aside, aside), "base.wz": (-turn, turn)},
        radius=0.12,
        rates=rates,
        skills=("look", "play", *SOUNDS),
    )


_HEAD = {"pan": PAN, "tilt": TILT, "nod": NOD}
_ENDS = ("min", "max")


def _is_address(host: str) -> bool:
    try:
        ip_address(host)
    except ValueError:
        return False
    return True


def _is_number(value: object) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _ports(table: object) -> dict[str, int]:
    if not isinstance(table, Mapping):
        raise _fault("ports", table, "a table of names and numbers, as in ports = {walk = 10050}")
    for name, port in table.items():
        if name not in PORTS:
            raise UsageError(f'driver "aibo": option ports has no {name!r}; known are {", ".join(PORTS)}')
        if type(port) is not int or not 1 <= port <= 65535:
            raise _fault(f"ports.{name}", port, f"a number from 1 to 65535, as in {name} = {PORTS[name]}")
    return {**PORTS, **table}


def _fault(key: str, value: object, remedy: str) -> UsageError:
    return UsageError(f'driver "aibo": option {key} is {value!r}, but must be {remedy}')
