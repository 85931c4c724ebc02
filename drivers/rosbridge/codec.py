"""Codec: what rosbridge's JSON says, in SI values; and what is said to it (ROSBRIDGE_PROTOCOL.md, version 2).

Pure: bytes in, messages out, and back.  rosbridge writes NaN and both infinities as null, and ``uint8[]`` as base64;
older ones write NaN and Infinity as they are.
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
from formats.jpeg import size_of

FAR_M, FAST, PULL = 1e6, 100.0, 1000.0
"""Beyond so many m, m/s or rad/s, and m/s2 a reading is absurd."""
MOST_READINGS = 20_000
"""Of a scan."""
MOST_VALUES = 2**16
"""In a message: a scan with its intensities has 40,000."""
MOST_DIGITS = 400
"""Characters of a number: the largest float in full has 309."""
CHARGING = 1
"""``power_supply_status`` of sensor_msgs/BatteryState."""


@dataclass(frozen=True)
class Published:
    """A message on a topic that was subscribed to."""

    topic: str
    message: Mapping[str, Any]


@dataclass(frozen=True)
class Answered:
    """A service has answered call ``id``; of one that failed, ``values`` has the reason as ``error``."""

    id: str
    values: Mapping[str, Any]
    is_done: bool


@dataclass(frozen=True)
class Status:
    """rosbridge itself says something: ``level`` is ``error``, ``warning``, ``info`` or ``none``."""

    level: str
    text: str


Message = Published | Answered | Status


# -- to the robot -----------------------------------------------------------------------------------------------------


def encoded(op: str, **fields: object) -> bytes:
    """One operation, its fields in the order in which they are given."""
    return json.dumps({"op": op, **fields}, separators=(",", ":"), allow_nan=False).encode()


def twist(vx: float, vy: float, wz: float) -> dict[str, Any]:
    """geometry_msgs/Twist."""
    return {"linear": {"x": vx, "y": vy, "z": 0.0}, "angular": {"x": 0.0, "y": 0.0, "z": wz}}


def twist_stamped(vx: float, vy: float, wz: float) -> dict[str, Any]:
    """geometry_msgs/TwistStamped of ROS 2; its stamp is 0, which bases read as "now": our clock is not theirs."""
    return {"header": {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": "base_link"}, "twist": twist(vx, vy, wz)}


# -- from the robot ---------------------------------------------------------------------------------------------------


def decoded(data: bytes) -> Message:
    """One message; raises ``BadFrame``."""
    # Counted beforehand: to make so many objects takes up to a hundred times the memory of their text.
    if sum(map(data.count, (b",", b"[", b"{"))) >= MOST_VALUES:
        raise BadFrame(f"{len(data)} bytes of JSON have more than {MOST_VALUES} values")
    try:
        said = _DECODER.decode(str(data, "utf-8"))
    except (ValueError, RecursionError) as error:
        raise BadFrame(f"{len(data)} bytes are no JSON: {type(error).__name__}") from error
    if not isinstance(said, dict):
        raise BadFrame("JSON that is no operation")
    match said:
        case {"op": "publish", "topic": str(topic), "msg": dict(message)}:
            return Published(topic, message)
        case {"op": "service_response", "id": str(number), **rest}:
            values = rest.get("values")
            is_done = rest.get("result") is not False
            if isinstance(values, dict):
                return Answered(number, values, is_done)
            return Answered(number, {"error": brief(values or "no reason given", 200)}, is_done)
        case {"op": "status", "level": str(level), **rest}:
            return Status(level, brief(rest.get("msg", ""), 300))
    raise BadFrame(f"operation {brief(said.get('op'), 40)!r} with wrong fields, or none that is known")


def brief(value: object, most: int) -> str:
    """The beginning of a value as text; of a list or an object its type only, which may be large and deeply nested."""
    is_plain = value is None or isinstance(value, (str, int, float))
    return str(value)[:most] if is_plain else f"a {type(value).__name__}"


def odometry(message: Mapping[str, Any]) -> dict[str, Value]:
    """nav_msgs/Odometry: the place, and the speed in the robot's own frame; raises ``BadFrame``."""
    pose = _at(message, "pose", "pose")
    speed = _at(message, "twist", "twist")
    place, linear = _at(pose, "position"), _at(speed, "linear")
    vx, vy = _number(linear, "x", FAST), _number(linear, "y", FAST)
    wz = _number(_at(speed, "angular"), "z", FAST)
    return {
        "odom.x": _number(place, "x", FAR_M),
        "odom.y": _number(place, "y", FAR_M),
        "odom.yaw": angles(_at(pose, "orientation"))[2],
        "base.vx": vx,
        "base.vy": vy,
        "base.wz": wz,
        "base.moving": math.hypot(vx, vy) > 0.01 or abs(wz) > 0.02,
    }


def scan(message: Mapping[str, Any], sectors: Mapping[str, tuple[float, float]], turn: float = 0.0) -> dict[str, Value]:
    """sensor_msgs/LaserScan: the nearest thing in each sector (middle and whole width in rad), in metres.

    ``turn`` is how the scanner stands on the robot.  Below ``range_min`` (0.0 is what many write for "no echo"),
    above ``range_max`` and null are no echo; a sector without any echo is NaN.  Raises ``BadFrame``.
    """
    first, step = _number(message, "angle_min", 10.0), _number(message, "angle_increment", 10.0)
    low, high = _number(message, "range_min", FAR_M), _number(message, "range_max", FAR_M)
    readings = message.get("ranges")
    if not isinstance(readings, Sequence) or isinstance(readings, str) or not 1 <= len(readings) <= MOST_READINGS:
        raise BadFrame(f"a scan must have 1 to {MOST_READINGS} ranges")
    if step == 0.0 or not 0.0 <= low < high:
        raise BadFrame(f"a scan from {low:g} to {high:g} m in steps of {step:g} rad is absurd")
    nearest = dict.fromkeys(sectors, math.nan)
    for place, reading in enumerate(readings):
        if isinstance(reading, bool) or not (reading is None or isinstance(reading, (int, float))):
            raise BadFrame("a range is no number")
        if reading is None or not low <= reading <= high:
            continue
        angle = turn + first + place * step
        for name, (middle, width) in sectors.items():
            if abs(math.remainder(angle - middle, math.tau)) <= width / 2 and not reading >= nearest[name]:
                nearest[name] = float(reading)
    return {f"range.{name}": distance for name, distance in nearest.items()}


def imu(message: Mapping[str, Any]) -> dict[str, Value]:
    """sensor_msgs/Imu: proper acceleration, and the attitude where it is known; raises ``BadFrame``."""
    pull = _at(message, "linear_acceleration")
    values: dict[str, Value] = {f"imu.a{axis}": _number(pull, axis, PULL) for axis in "xyz"}
    covariance = message.get("orientation_covariance")
    if not (isinstance(covariance, list) and covariance and covariance[0] == -1):
        roll, pitch, yaw = angles(_at(message, "orientation"))
        values |= {"imu.roll": roll, "imu.pitch": pitch, "imu.yaw": yaw}
    return values


def battery(message: Mapping[str, Any], full: float = 1.0) -> dict[str, Value]:
    """sensor_msgs/BatteryState: what of it is known; ``full`` is its percentage of a full one, 1 or 100.

    Raises ``BadFrame`` where nothing is known, or a level cannot be.
    """
    values: dict[str, Value] = {}
    for key, name, most in (("power.volts", "voltage", 1000.0), ("power.amps", "current", 1000.0)):
        if _is_number(message.get(name)):
            values[key] = _number(message, name, most)
    if _is_number(message.get("percentage")):
        level = _number(message, "percentage", 1e6) / full
        if not 0.0 <= level <= 1.01:
            raise BadFrame(f"a battery is full to {level:g}; battery_full says what a full one reports, 1 or 100")
        values["power.level"] = min(level, 1.0)
    if not values:
        raise BadFrame("a battery that says nothing")
    values["power.charging"] = message.get("power_supply_status") == CHARGING
    return values


def picture(message: Mapping[str, Any]) -> tuple[bytes, int, int]:
    """sensor_msgs/CompressedImage: a whole JPEG, its width and height; raises ``BadFrame``."""
    text = message.get("data")
    try:
        data = base64.b64decode(text, validate=True) if isinstance(text, str) else b""
    except ValueError as error:
        raise BadFrame("a picture is no base64") from error
    size = size_of(data)
    if size is None:
        raise BadFrame(f"a picture is no whole JPEG, but {brief(message.get('format'), 40)!r}")
    return data, *size


def stamp(message: Mapping[str, Any]) -> float | None:
    """When the robot says that it was, in its own seconds; None where it does not say."""
    header = message.get("header")
    at = header.get("stamp") if isinstance(header, dict) else None
    if not isinstance(at, dict):
        return None
    seconds, nanos = at.get("sec", at.get("secs")), at.get("nanosec", at.get("nsecs"))
    if type(seconds) is not int or type(nanos) is not int or not 0 <= seconds < 2**32 or not 0 <= nanos < 10**9:
        return None
    return seconds + nanos / 1e9


def angles(quaternion: Mapping[str, Any]) -> tuple[float, float, float]:
    """Roll, pitch and yaw in rad; raises ``BadFrame`` for what is no rotation."""
    x, y, z, w = (_number(quaternion, axis, 2.0) for axis in "xyzw")
    if not 0.9 < x * x + y * y + z * z + w * w < 1.1:
        raise BadFrame("an orientation is no rotation")
    roll = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = math.asin(max(-1.0, min(1.0, 2 * (w * y - z * x))))
    return roll, pitch, math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def _whole(text: str) -> int:
    return int(_short(text))


def _fraction(text: str) -> float:
    return float(_short(text))


def _short(text: str) -> str:
    if len(text) > MOST_DIGITS:
        raise ValueError(f"a number of {len(text)} characters")
    return text


_DECODER = json.JSONDecoder(parse_int=_whole, parse_float=_fraction)


def _at(message: Mapping[str, Any], *path: str) -> Mapping[str, Any]:
    found: Any = message
    for name in path:
        found = found.get(name) if isinstance(found, dict) else None
    if not isinstance(found, dict):
        raise BadFrame(f"{'.'.join(path)} is missing")
    return found


def _number(message: Mapping[str, Any], name: str, most: float) -> float:
    value: Any = message.get(name)
    if not _is_number(value) or not -most <= value <= most:
        raise BadFrame(f"{name} is {brief(value, 40)}")
    return float(value)


def _is_number(value: Any) -> bool:
    # A huge integer is no float, and null, NaN and the infinities are no reading.
    return isinstance(value, (int, float)) and not isinstance(value, bool) and -1e300 < value < 1e300
