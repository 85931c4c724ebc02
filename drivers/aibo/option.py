"""Options of the kind "aibo"; each error says how to correct it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from ipaddress import ip_address
from typing import Annotated, Literal

from msgspec import Meta

from drivers.aibo.sensors import MODEL, NOD, PAN, TILT
from drivers.option import Fps, Host, Port, convert_options, make_option_error
from drivers.reading import Description
from formats.convert import ConversionStep

PORTS: dict[str, int] = {"main": 10020, "estop": 10053, "state": 10031, "walk": 10050, "head": 10052, "camera": 10011}
"""Servers that the driver connects to, with Tekkotsu's port numbers."""
MAX_FORWARD_MPS, MAX_BACKWARD_MPS, MAX_STRAFE_MPS, MAX_TURN_RADPS = 0.160, 0.156, 0.103, 2.03
"""Top speeds of the stock walk, in m/s and rad/s."""
SOUNDS = {"howl": "5", "yap": "6", "whimper": "7", "growl": "8", "bark": "9"}
"""Sounds of the walk server, and the letters of their commands."""
Transport = Literal["tcp", "udp"]
Speed = Annotated[float, Meta(gt=0, le=10)]
HEIGHTS = {104: 80, 208: 160}
"""The height of a camera picture by its width, in pixels."""


def _complete_ports(given: Mapping[str, int]) -> dict[str, int]:
    unknown = [name for name in given if name not in PORTS]
    if unknown:
        raise ValueError(f"has no {unknown[0]!r}")
    return {**PORTS, **given}


@dataclass(frozen=True)
class Options:
    """The dog's address, the transport of its camera pictures, the speeds of its walk, and its ports."""

    host: Host
    camera: bool = True
    camera_fps: Fps = 15.0
    camera_transport: Transport = "tcp"
    camera_width: Literal[104, 208] = 104
    speed: Annotated[
        tuple[Speed, Speed, Speed, Speed],
        Meta(description="forward, backward, aside (m/s) and turn (rad/s), each above 0 and at most 10"),
    ] = (MAX_FORWARD_MPS, MAX_BACKWARD_MPS, MAX_STRAFE_MPS, MAX_TURN_RADPS)
    ports: Annotated[
        Mapping[str, int],
        Meta(description=f"a table of ports, such as {{walk = 10050}}; its keys are {', '.join(PORTS)}"),
        ConversionStep(_complete_ports, raw=dict[str, Port]),
    ] = field(default_factory=lambda: dict(PORTS))

    @property
    def wanted_fps(self) -> float:
        """The requested frame rate in pictures per second."""
        return self.camera_fps if self.camera else 0.0


def parse_options(table: Mapping[str, object]) -> Options:
    """Convert and check ``table``; raise ``UsageError`` with the key, the problem and the remedy."""
    options = convert_options("aibo", table, Options)
    if options.camera_transport == "udp" and not _is_address(options.host):
        problem = f'must be a numeric address with camera_transport = "udp", is {options.host!r}'
        raise make_option_error("aibo", "host", problem, 'write a numeric address, such as "192.168.0.51"')
    return options


def make_description(options: Options) -> Description:
    """Return the description of an ERS-7."""
    forward, backward, aside, turn = options.speed
    capabilities: dict[str, Mapping[str, float | str]] = {
        "base2d": {},
        "odometry": {"estimated": 1.0},
        "ranger": {"max": 1.5},
        "imu": {},
        "joints": {"count": 18.0, "read_only": 1.0},
        "ptz": {
            f"{name}_{end}": value for name, ends in _HEAD_AXES.items() for end, value in zip(_ENDS, ends, strict=True)
        },
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


_HEAD_AXES = {"pan": PAN, "tilt": TILT, "nod": NOD}
_ENDS = ("min", "max")


def _is_address(host: str) -> bool:
    try:
        ip_address(host)
    except ValueError:
        return False
    return True
