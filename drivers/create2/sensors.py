"""Convert a frame of the Create 2 to the keys of an observation; pure."""

from __future__ import annotations

from collections.abc import Mapping

from drivers.create2.codec import MODES
from drivers.reading import Value

PACKET_IDS = (
    7,
    9,
    10,
    11,
    12,
    13,
    14,
    17,
    18,
    21,
    22,
    23,
    24,
    25,
    26,
    28,
    29,
    30,
    31,
    34,
    35,
    43,
    44,
    *range(45, 52),
    58,
)
"""The streamed packets: a frame of 81 bytes, about half of the line's capacity."""
CLIFF_SENSORS = ("left", "front_left", "front_right", "right")
LIGHT_BUMPERS = ("left", "front_left", "center_left", "center_right", "front_right", "right")
BUTTONS = ("clean", "spot", "dock", "minute", "hour", "day", "schedule", "clock")
DRIVING_MODES = ("safe", "full")
CHARGING_STATES = (1, 2, 3)
HOME_BASE = 2


def get_mode(frame: Mapping[str, int]) -> str:
    """Return the mode, ``off passive safe full``; the wheels obey commands only in the modes safe and full."""
    return MODES[frame["mode"]]


def convert_frame(frame: Mapping[str, int]) -> dict[str, Value]:
    """Return the sensor data in SI units; the battery's level is omitted if the robot does not know its capacity."""
    values: dict[str, Value] = {
        "mode": get_mode(frame),
        "estop.engaged": get_mode(frame) not in DRIVING_MODES,
        "bump.right": bool(frame["bumps"] & 1),
        "bump.left": bool(frame["bumps"] & 2),
        "wheeldrop.right": bool(frame["bumps"] & 4),
        "wheeldrop.left": bool(frame["bumps"] & 8),
        "stall.moving": bool(frame["stasis"] & 1),
        "stall.left": bool(frame["overcurrent"] & 16),
        "stall.right": bool(frame["overcurrent"] & 8),
        "wall.virtual": bool(frame["virtual_wall"]),
        "infrared": float(frame["infrared"]),
        "power.volts": frame["voltage"] / 1000.0,
        "power.amps": frame["current"] / 1000.0,
        "power.celsius": float(frame["temperature"]),
        "power.charging": frame["charging_state"] in CHARGING_STATES,
        "dock.on": bool(frame["charger"] & HOME_BASE),
    }
    if frame["capacity"] > 0:
        values["power.level"] = min(1.0, frame["charge"] / frame["capacity"])
    for name in CLIFF_SENSORS:
        values[f"cliff.{name}"] = bool(frame[f"cliff_{name}"])
        values[f"cliff.{name}.signal"] = frame[f"cliff_{name}_signal"] / 4095.0
    for bit, name in enumerate(LIGHT_BUMPERS):
        values[f"lightbump.{name}"] = frame[f"light_{name}"] / 4095.0
        values[f"lightbump.{name}.hit"] = bool(frame["light_bumper"] >> bit & 1)
    for bit, name in enumerate(BUTTONS):
        values[f"button.{name}"] = float(frame["buttons"] >> bit & 1)
    return values


def describe_safety_event(values: Mapping[str, Value]) -> str:
    """Return the reasons why the robot left safe mode by itself, according to its sensors."""
    causes = [
        key
        for key in (*(f"cliff.{name}" for name in CLIFF_SENSORS), "wheeldrop.left", "wheeldrop.right")
        if values[key]
    ]
    if values["dock.on"] or values["power.charging"]:
        causes.append("charger")
    return ", ".join(causes) or "mode"
