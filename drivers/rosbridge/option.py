"""Options of the kind "rosbridge": where it is, which topic is what, and what the robot can do; checked."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from drivers.driver import MAX_FPS
from drivers.errors import UsageError
from drivers.reading import Description

DEFAULT_PORT = 9090
VELOCITY_TYPES = ("auto", "twist", "twist_stamped")
SECTORS: Mapping[str, tuple[float, float]] = {
    "front": (0.0, 40.0),
    "front_left": (45.0, 40.0),
    "left": (90.0, 40.0),
    "back": (180.0, 60.0),
    "right": (-90.0, 40.0),
    "front_right": (-45.0, 40.0),
}
"""The middle and the whole width of each, in degrees; left is positive."""
TYPES = {
    "odometry": "nav_msgs/Odometry",
    "scan": "sensor_msgs/LaserScan",
    "imu": "sensor_msgs/Imu",
    "battery": "sensor_msgs/BatteryState",
    "image": "sensor_msgs/CompressedImage",
}
"""What is observed, to the type of its topic in ROS 1; ROS 2 writes ``/msg/`` in the middle."""
RATES = {"odometry": 20.0, "scan": 10.0, "imu": 20.0, "battery": 1.0}
"""How often each is asked for, a second at most."""


@dataclass(frozen=True)
class Options:
    """The robot; an empty topic means that it has none.

    ``velocity_type`` "auto" asks the robot (rosapi).  ``max_vx`` and ``max_vy`` are in m/s, ``max_wz`` in rad/s,
    ``radius`` in m.  ``scan_turn`` is how the scanner stands on the robot in degrees, ``battery_full`` what a full
    battery reports.  ``motor_service`` (std_srvs/SetBool) switches the motors of robots that have one;
    ``services`` maps skills to services without arguments (std_srvs/Trigger).
    """

    host: str = "127.0.0.1"
    port: int = DEFAULT_PORT
    path: str = "/"
    ros: int = 2
    model: str = "ROS robot"
    velocity_topic: str = "/cmd_vel"
    velocity_type: str = "auto"
    odometry_topic: str = "/odom"
    scan_topic: str = "/scan"
    imu_topic: str = ""
    battery_topic: str = "/battery_state"
    image_topic: str = ""
    camera_fps: float = 10.0
    camera_width: int = 640
    camera_height: int = 480
    camera_lens: float = 62.0
    max_vx: float = 0.22
    max_vy: float = 0.0
    max_wz: float = 2.84
    max_range: float = 3.5
    radius: float = 0.11
    scan_turn: float = 0.0
    battery_full: float = 1.0
    motor_service: str = ""
    services: Mapping[str, str] = field(default_factory=dict)

    @property
    def topics(self) -> dict[str, str]:
        """What is observed, to its topic; only what the robot has, and the image always where it has one."""
        return {name: topic for name in TYPES if (topic := str(getattr(self, f"{name}_topic")))}

    def type_of(self, name: str) -> str:
        """A ROS 1 type as this robot writes it."""
        return name if self.ros == 1 else name.replace("/", "/msg/")


_Rule = tuple[Callable[[Any], bool], str]


def _text(least: int, most: int) -> Callable[[Any], bool]:
    return lambda value: isinstance(value, str) and least <= len(value) <= most and value.isprintable()


def _topic(is_needed: bool) -> Callable[[Any], bool]:
    def fits(value: Any) -> bool:
        if value == "":
            return not is_needed
        return isinstance(value, str) and len(value) <= 200 and value.startswith("/") and value.isascii()

    return fits


def _whole(low: int, high: int) -> Callable[[Any], bool]:
    return lambda value: type(value) is int and low <= value <= high


def _real(low: float, high: float) -> Callable[[Any], bool]:
    def fits(value: Any) -> bool:
        return isinstance(value, (int, float)) and not isinstance(value, bool) and low <= value <= high

    return fits


def _services(value: Any) -> bool:
    return isinstance(value, Mapping) and all(
        isinstance(name, str) and name.isidentifier() and _topic(True)(service) for name, service in value.items()
    )


_RULES: Mapping[str, _Rule] = {
    "host": (_text(1, 253), 'the address of the robot, as in host = "192.168.1.20"'),
    "port": (_whole(1, 65535), f"a number from 1 to 65535, as in port = {DEFAULT_PORT}"),
    "path": (lambda v: _topic(True)(v) and " " not in v and v.isprintable(), 'a path, as in path = "/"'),
    "ros": (_whole(1, 2), "1 or 2, the version of ROS on the robot"),
    "model": (_text(1, 60), 'a name, as in model = "TurtleBot 3 Burger"'),
    "velocity_topic": (_topic(True), 'a topic, as in velocity_topic = "/cmd_vel"'),
    "velocity_type": (lambda v: v in VELOCITY_TYPES, f"one of {', '.join(VELOCITY_TYPES)}"),
    **{f"{name}_topic": (_topic(False), f'a topic, or "" where there is no {name}') for name in TYPES},
    "camera_fps": (_real(0, MAX_FPS), f"pictures a second from 0 to {MAX_FPS:g}, as in camera_fps = 10"),
    "camera_width": (_whole(16, 4096), "pixels from 16 to 4096, as in camera_width = 640"),
    "camera_height": (_whole(16, 4096), "pixels from 16 to 4096, as in camera_height = 480"),
    "camera_lens": (_real(5, 180), "degrees across the picture from 5 to 180, as in camera_lens = 62"),
    "max_vx": (_real(0.01, 5), "m/s from 0.01 to 5, as in max_vx = 0.22"),
    "max_vy": (_real(0, 5), "m/s from 0 (it cannot go sideways) to 5, as in max_vy = 0"),
    "max_wz": (_real(0.01, 20), "rad/s from 0.01 to 20, as in max_wz = 2.84"),
    "max_range": (_real(0.1, 200), "metres from 0.1 to 200, as in max_range = 3.5"),
    "radius": (_real(0.01, 5), "metres from 0.01 to 5, as in radius = 0.11"),
    "scan_turn": (_real(-360, 360), "degrees from -360 to 360, left positive, as in scan_turn = 90"),
    "battery_full": (lambda v: not isinstance(v, bool) and v in (1, 100), "1 or 100, what a full battery reports"),
    "motor_service": (_topic(False), 'a service, as in motor_service = "/motor_power", or ""'),
    "services": (_services, 'a table of skills to services, as in services = {dock = "/dock"}'),
}


def checked(table: Mapping[str, object]) -> Options:
    """The options in ``table``; raises ``UsageError`` that names the key and what to write instead."""
    for key, value in table.items():
        if key not in _RULES:
            raise UsageError(f'driver "rosbridge": unknown option {key!r}; known are {", ".join(_RULES)}')
        fits, remedy = _RULES[key]
        if not fits(value):
            raise UsageError(f'driver "rosbridge": option {key} is {value!r}, but must be {remedy}')
    options = Options(**table)  # type: ignore[arg-type]
    if not any(topic for name, topic in options.topics.items() if name in ("odometry", "scan", "imu")):
        raise UsageError('driver "rosbridge": give odometry_topic, scan_topic or imu_topic, or nobody sees it is alive')
    return options


def described(options: Options) -> Description:
    """What the robot is, as far as the options say."""
    capabilities: dict[str, Mapping[str, float | str]] = {"base2d": {}}
    topics = options.topics
    named = {"odometry": "odometry", "scan": "ranger", "imu": "imu", "battery": "power"}
    rates = {"state": max(RATES[name] for name in topics if name in RATES)}
    for name, capability in named.items():
        if name in topics:
            capabilities[capability] = {"max": options.max_range} if name == "scan" else {}
    if "image" in topics and options.camera_fps > 0:
        camera = {"width": options.camera_width, "height": options.camera_height, "fps": options.camera_fps}
        capabilities["camera"] = {**camera, "fov_h_deg": options.camera_lens}
        rates["camera"] = options.camera_fps
    limits = {"base.vx": (-options.max_vx, options.max_vx), "base.wz": (-options.max_wz, options.max_wz)}
    if options.max_vy > 0:
        limits["base.vy"] = (-options.max_vy, options.max_vy)
    return Description(
        "rosbridge", options.model, capabilities, limits, options.radius, rates, tuple(sorted(options.services))
    )


def sectors() -> dict[str, tuple[float, float]]:
    """``SECTORS`` in rad."""
    return {name: (math.radians(middle), math.radians(width)) for name, (middle, width) in SECTORS.items()}
