"""Options of the kind "rosbridge": its address, its topics, and the limits of the robot."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Literal

from msgspec import Meta

from drivers.errors import UsageError
from drivers.option import Fps, Port, convert_options
from drivers.reading import Description
from formats.convert import PRINTABLE, ConversionStep, Unit

DEFAULT_PORT = 9090
VelocityType = Literal["auto", "twist", "twist_stamped"]
Topic = Annotated[str, Meta(max_length=200, pattern=r"^/[\x00-\x7f]*$(?!\n)", examples=["/cmd_vel"])]
AnyTopic = Annotated[
    str, Meta(max_length=200, pattern=r"^(/[\x00-\x7f]*)?$(?!\n)", description="a topic, or empty", examples=["/scan"])
]
Pixels = Annotated[int, Meta(ge=16, le=4096), Unit("pixels")]
SECTORS: Mapping[str, tuple[float, float]] = {
    "front": (0.0, 40.0),
    "front_left": (45.0, 40.0),
    "left": (90.0, 40.0),
    "back": (180.0, 60.0),
    "right": (-90.0, 40.0),
    "front_right": (-45.0, 40.0),
}
"""The centre and the full width of each sector of a scan in degrees, left positive."""
ROS_TYPES = {
    "odometry": "nav_msgs/Odometry",
    "scan": "sensor_msgs/LaserScan",
    "imu": "sensor_msgs/Imu",
    "battery": "sensor_msgs/BatteryState",
    "image": "sensor_msgs/CompressedImage",
}
"""Sources of observations, and the types of their topics in ROS 1; in ROS 2 the types contain ``/msg/``."""
RATES_HZ = {"odometry": 20.0, "scan": 10.0, "imu": 20.0, "battery": 1.0}
"""Maximum requested rate of each source in Hz."""


def _check_skills(services: Mapping[str, str]) -> Mapping[str, str]:
    for name in services:
        if not name.isidentifier():
            raise ValueError(f"has {name!r}, which is not a valid skill name")
    return services


def _check_full(value: float) -> float:
    if value not in (1, 100):
        raise ValueError
    return value


@dataclass(frozen=True)
class Options:
    """The robot; an empty topic means that the robot lacks the device of this topic.

    With ``velocity_type`` "auto" the driver asks the robot (rosapi) for the type.  ``max_vx`` and ``max_vy`` are in
    m/s, ``max_wz`` in rad/s, ``radius`` in m.  ``scan_turn`` is the rotation of the scanner on the robot in degrees,
    ``battery_full`` the percentage of a full battery.  ``motor_service`` (std_srvs/SetBool) switches the motors, on
    robots that have such a service; ``services`` maps skills to services without arguments (std_srvs/Trigger).
    """

    host: Annotated[str, Meta(min_length=1, max_length=253), PRINTABLE] = "127.0.0.1"
    port: Port = DEFAULT_PORT
    path: Annotated[str, Meta(max_length=200, pattern=r"^/[!-~]*$(?!\n)")] = "/"
    ros: Literal[1, 2] = 2
    model: Annotated[str, Meta(min_length=1, max_length=60), PRINTABLE] = "ROS robot"
    velocity_topic: Topic = "/cmd_vel"
    velocity_type: VelocityType = "auto"
    odometry_topic: AnyTopic = "/odom"
    scan_topic: AnyTopic = "/scan"
    imu_topic: AnyTopic = ""
    battery_topic: AnyTopic = "/battery_state"
    image_topic: AnyTopic = ""
    camera_fps: Fps = 10.0
    camera_width: Pixels = 640
    camera_height: Pixels = 480
    camera_lens: Annotated[float, Meta(ge=5, le=180), Unit("degrees across the picture")] = 62.0
    max_vx: Annotated[float, Meta(ge=0.01, le=5), Unit("m/s")] = 0.22
    max_vy: Annotated[float, Meta(ge=0, le=5), Unit("m/s (0: it cannot go sideways)")] = 0.0
    max_wz: Annotated[float, Meta(ge=0.01, le=20), Unit("rad/s")] = 2.84
    max_range: Annotated[float, Meta(ge=0.1, le=200), Unit("metres")] = 3.5
    radius: Annotated[float, Meta(ge=0.01, le=5), Unit("metres")] = 0.11
    scan_turn: Annotated[float, Meta(ge=-360, le=360), Unit("degrees to the left")] = 0.0
    battery_full: Annotated[
        float, Meta(description="1 or 100, what a full battery reports"), ConversionStep(_check_full)
    ] = 1.0
    motor_service: AnyTopic = ""
    services: Annotated[
        Mapping[str, str],
        Meta(description='a table of skills to services, such as {dock = "/dock"}'),
        ConversionStep(_check_skills, raw=dict[str, Topic]),
    ] = field(default_factory=dict)

    @property
    def topics(self) -> dict[str, str]:
        """The sources of observations, and their topics; includes the image topic even at frame rate 0."""
        return {name: topic for name in ROS_TYPES if (topic := str(getattr(self, f"{name}_topic")))}

    def convert_type_name(self, name: str) -> str:
        """Return the name of a ROS 1 type in the robot's version of ROS."""
        return name if self.ros == 1 else name.replace("/", "/msg/")


def parse_options(table: Mapping[str, object]) -> Options:
    """Convert and check ``table``; raise ``UsageError`` with the key, the problem and the remedy."""
    options = convert_options("rosbridge", table, Options)
    if not any(topic for name, topic in options.topics.items() if name in ("odometry", "scan", "imu")):
        raise UsageError('driver "rosbridge": odometry_topic, scan_topic and imu_topic are all empty; set one of them')
    return options


def make_description(options: Options) -> Description:
    """Return the description of the robot according to its options."""
    capabilities: dict[str, Mapping[str, float | str]] = {"base2d": {}}
    topics = options.topics
    named = {"odometry": "odometry", "scan": "ranger", "imu": "imu", "battery": "power"}
    rates = {"state": max(RATES_HZ[name] for name in topics if name in RATES_HZ)}
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
