"""Codec of rosbridge's JSON, to and from SI values (ROSBRIDGE_PROTOCOL.md, version 2).

Pure: bytes in, messages out, and back.  rosbridge writes NaN and both infinities as null, and ``uint8[]`` as base64;
older versions write NaN and Infinity literally.
"""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from drivers.errors import BadFrame
from drivers.reading import Value
from formats.jpeg import read_size

MAX_DISTANCE_M, MAX_SPEED, MAX_ACCELERATION_MPS2 = 1e6, 100.0, 1000.0
"""Maximum plausible readings: distance in metres, speed in m/s or rad/s, acceleration in m/s2."""
MAX_READINGS = 20_000
"""Maximum number of readings in a scan."""
MAX_VALUES = 2**16
"""Maximum number of values in a message; a scan with its intensities has 40,000."""
MAX_NUMBER_CHARS = 400
"""Maximum number of characters of a number; the largest float, written in full, has 309."""
CHARGING = 1
"""``power_supply_status`` of sensor_msgs/BatteryState."""


@dataclass(frozen=True)
class TopicMessage:
    """A message on a subscribed topic."""

    topic: str
    message: Mapping[str, Any]


@dataclass(frozen=True)
class ServiceResponse:
    """The answer of a service to the call ``id``; after a failure ``values`` contains the reason as ``error``."""

    id: str
    values: Mapping[str, Any]
    is_done: bool


@dataclass(frozen=True)
class Status:
    """A status message of rosbridge: ``level`` is ``error``, ``warning``, ``info`` or ``none``."""

    level: str
    text: str


Message = TopicMessage | ServiceResponse | Status


# -- to the robot -----------------------------------------------------------------------------------------------------


def encode_operation(op: str, **fields: object) -> bytes:
    """Encode one operation; the order of the fields is kept."""
    return json.dumps({"op": op, **fields}, separators=(",", ":"), allow_nan=False).encode()


def make_twist(vx: float, vy: float, wz: float) -> dict[str, Any]:
    """Return a geometry_msgs/Twist."""
    return {"linear": {"x": vx, "y": vy, "z": 0.0}, "angular": {"x": 0.0, "y": 0.0, "z": wz}}


def make_twist_stamped(vx: float, vy: float, wz: float) -> dict[str, Any]:
    """Return a geometry_msgs/TwistStamped of ROS 2 with stamp 0, which bases treat as "now", because clocks differ."""
    return {"header": {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": "base_link"}, "twist": make_twist(vx, vy, wz)}


# -- from the robot ---------------------------------------------------------------------------------------------------


def decode_message(data: bytes) -> Message:
    """Decode one message; raise ``BadFrame`` if it is invalid."""
    # Count before decoding: the objects take up to a hundred times the memory of their text.
    if sum(map(data.count, (b",", b"[", b"{"))) >= MAX_VALUES:
        raise BadFrame(f"{len(data)} bytes of JSON have more than {MAX_VALUES} values")
    try:
        operation = _DECODER.decode(str(data, "utf-8"))
    except (ValueError, RecursionError) as error:
        raise BadFrame(f"{len(data)} bytes are not valid JSON: {type(error).__name__}") from error
    if not isinstance(operation, dict):
        raise BadFrame("the message is JSON, but not an operation of rosbridge")
    match operation:
        case {"op": "publish", "topic": str(topic), "msg": dict(message)}:
            return TopicMessage(topic, message)
        case {"op": "service_response", "id": str(number), **rest}:
            values = rest.get("values")
            is_done = rest.get("result") is not False
            if isinstance(values, dict):
                return ServiceResponse(number, values, is_done)
            return ServiceResponse(number, {"error": shorten(values or "no reason given", 200)}, is_done)
        case {"op": "status", "level": str(level), **rest}:
            return Status(level, shorten(rest.get("msg", ""), 300))
    raise BadFrame(f"operation {shorten(operation.get('op'), 40)!r} is unknown or has wrong fields")


def shorten(value: object, most: int) -> str:
    """Return the start of a scalar as text, or the type of a list or object, which may be large and deeply nested."""
    is_plain = value is None or isinstance(value, (str, int, float))
    return str(value)[:most] if is_plain else f"a {type(value).__name__}"


def convert_odometry(message: Mapping[str, Any]) -> dict[str, Value]:
    """Convert nav_msgs/Odometry: the pose, and the speed in the robot's frame; raise ``BadFrame`` if invalid."""
    pose = _get_nested(message, "pose", "pose")
    speed = _get_nested(message, "twist", "twist")
    position, linear = _get_nested(pose, "position"), _get_nested(speed, "linear")
    vx, vy = _read_number(linear, "x", MAX_SPEED), _read_number(linear, "y", MAX_SPEED)
    wz = _read_number(_get_nested(speed, "angular"), "z", MAX_SPEED)
    return {
        "odom.x": _read_number(position, "x", MAX_DISTANCE_M),
        "odom.y": _read_number(position, "y", MAX_DISTANCE_M),
        "odom.yaw": convert_quaternion(_get_nested(pose, "orientation"))[2],
        "base.vx": vx,
        "base.vy": vy,
        "base.wz": wz,
        "base.moving": math.hypot(vx, vy) > 0.01 or abs(wz) > 0.02,
    }


def convert_scan(
    message: Mapping[str, Any], sectors: Mapping[str, tuple[float, float]], turn: float = 0.0
) -> dict[str, Value]:
    """Convert sensor_msgs/LaserScan to the nearest distance in each sector (centre and full width in rad), in metres.

    ``turn`` is the rotation of the scanner on the robot.  Readings below ``range_min`` (often 0.0), above
    ``range_max`` or null mean "no echo"; a sector without any echo is NaN.  Raises ``BadFrame``.
    """
    first, step = _read_number(message, "angle_min", 10.0), _read_number(message, "angle_increment", 10.0)
    low, high = _read_number(message, "range_min", MAX_DISTANCE_M), _read_number(message, "range_max", MAX_DISTANCE_M)
    readings = message.get("ranges")
    if not isinstance(readings, Sequence) or isinstance(readings, str) or not 1 <= len(readings) <= MAX_READINGS:
        raise BadFrame(f"a scan must have 1 to {MAX_READINGS} ranges")
    if step == 0.0 or not 0.0 <= low < high:
        raise BadFrame(f"invalid scan: range {low:g} to {high:g} m, angle increment {step:g} rad")
    nearest = dict.fromkeys(sectors, math.nan)
    for position, reading in enumerate(readings):
        if isinstance(reading, bool) or not (reading is None or isinstance(reading, (int, float))):
            raise BadFrame("a range is not a number")
        if reading is None or not low <= reading <= high:
            continue
        angle = turn + first + position * step
        for name, (middle, width) in sectors.items():
            if abs(math.remainder(angle - middle, math.tau)) <= width / 2 and not reading >= nearest[name]:
                nearest[name] = float(reading)
    return {f"range.{name}": distance for name, distance in nearest.items()}


def convert_imu(message: Mapping[str, Any]) -> dict[str, Value]:
    """Convert sensor_msgs/Imu: proper acceleration, and the attitude if it is known; raise ``BadFrame`` if invalid."""
    acceleration = _get_nested(message, "linear_acceleration")
    values: dict[str, Value] = {
        f"imu.a{axis}": _read_number(acceleration, axis, MAX_ACCELERATION_MPS2) for axis in "xyz"
    }
    covariance = message.get("orientation_covariance")
    if not (isinstance(covariance, list) and covariance and covariance[0] == -1):
        roll, pitch, yaw = convert_quaternion(_get_nested(message, "orientation"))
        values |= {"imu.roll": roll, "imu.pitch": pitch, "imu.yaw": yaw}
    return values


def convert_battery(message: Mapping[str, Any], full: float = 1.0) -> dict[str, Value]:
    """Convert the known values of sensor_msgs/BatteryState; ``full`` is the percentage of a full battery, 1 or 100.

    Raises ``BadFrame`` if no value is known or the level is out of range.
    """
    values: dict[str, Value] = {}
    for key, name, most in (("power.volts", "voltage", 1000.0), ("power.amps", "current", 1000.0)):
        if _is_number(message.get(name)):
            values[key] = _read_number(message, name, most)
    if _is_number(message.get("percentage")):
        level = _read_number(message, "percentage", 1e6) / full
        if not 0.0 <= level <= 1.01:
            raise BadFrame(
                f"the battery level {level:g} is not from 0 to 1; set battery_full to the level of a full battery"
            )
        values["power.level"] = min(level, 1.0)
    if not values:
        raise BadFrame("the battery message contains no known value (voltage, current, percentage)")
    values["power.charging"] = message.get("power_supply_status") == CHARGING
    return values


def decode_picture(message: Mapping[str, Any]) -> tuple[bytes, int, int]:
    """Convert sensor_msgs/CompressedImage to a complete JPEG, its width and height; raise ``BadFrame`` if invalid."""
    text = message.get("data")
    try:
        data = base64.b64decode(text, validate=True) if isinstance(text, str) else b""
    except ValueError as error:
        raise BadFrame("the picture is not base64") from error
    size = read_size(data)
    if size is None:
        raise BadFrame(f"a picture is not a complete JPEG; its format is {shorten(message.get('format'), 40)!r}")
    return data, *size


def read_stamp(message: Mapping[str, Any]) -> float | None:
    """Return the message's time in seconds on the robot's clock; None without a stamp."""
    header = message.get("header")
    at = header.get("stamp") if isinstance(header, dict) else None
    if not isinstance(at, dict):
        return None
    seconds, nanos = at.get("sec", at.get("secs")), at.get("nanosec", at.get("nsecs"))
    if type(seconds) is not int or type(nanos) is not int or not 0 <= seconds < 2**32 or not 0 <= nanos < 10**9:
        return None
    return seconds + nanos / 1e9


def convert_quaternion(quaternion: Mapping[str, Any]) -> tuple[float, float, float]:
    """Return roll, pitch and yaw in rad; raise ``BadFrame`` if the quaternion is not a rotation."""
    x, y, z, w = (_read_number(quaternion, axis, 2.0) for axis in "xyzw")
    if not 0.9 < x * x + y * y + z * z + w * w < 1.1:
        raise BadFrame("the orientation is not a rotation")
    roll = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = math.asin(max(-1.0, min(1.0, 2 * (w * y - z * x))))
    return roll, pitch, math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def _parse_int(text: str) -> int:
    return int(_check_length(text))


def _parse_float(text: str) -> float:
    return float(_check_length(text))


def _check_length(text: str) -> str:
    if len(text) > MAX_NUMBER_CHARS:
        raise ValueError(f"a number has {len(text)} characters, which is too long")
    return text


_DECODER = json.JSONDecoder(parse_int=_parse_int, parse_float=_parse_float)


def _get_nested(message: Mapping[str, Any], *path: str) -> Mapping[str, Any]:
    found: Any = message
    for name in path:
        found = found.get(name) if isinstance(found, dict) else None
    if not isinstance(found, dict):
        raise BadFrame(f"{'.'.join(path)} is missing")
    return found


def _read_number(message: Mapping[str, Any], name: str, most: float) -> float:
    value: Any = message.get(name)
    if not _is_number(value) or not -most <= value <= most:
        raise BadFrame(f"{name} is {shorten(value, 40)}")
    return float(value)


def _is_number(value: Any) -> bool:
    # This excludes integers beyond the range of floats, null, NaN and infinities.
    return isinstance(value, (int, float)) and not isinstance(value, bool) and -1e300 < value < 1e300
