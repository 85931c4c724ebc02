"""Unit: how a reading is shown to a person, by its key."""

from __future__ import annotations

import math
from collections.abc import Sequence

UNITS: Sequence[tuple[tuple[str, ...], str]] = (
    (("base.wz",), "rad/s"),
    (("base.vx", "base.vy"), "m/s"),
    (("odom.yaw",), "rad"),
    (("odom.x", "odom.y", "range.", "target.distance"), "m"),
    (("imu.ax", "imu.ay", "imu.az"), "m/s2"),
    (("imu.", "ptz.", "compass.heading", "target.bearing", "orientation."), "rad"),
    (("power.volts",), "V"),
    (("power.amps",), "A"),
    (("power.celsius",), "C"),
)
"""The beginnings of keys, the first that fits, and the SI unit of what they tell."""


def unit_of(key: str) -> str:
    """The unit of a key's values; empty for shares, truths and words."""
    if key.startswith("joint.") and key.endswith(".pos"):
        return "rad"
    return next((unit for starts, unit in UNITS if key.startswith(starts)), "")


def shown(key: str, value: object) -> str:
    """A reading in words: with its unit, an angle in degrees as well."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, str):
        return value or "-"
    if not isinstance(value, float | int):
        return repr(value)
    if math.isnan(value):
        return "nothing in range" if key.startswith("range.") else "unknown"
    unit = unit_of(key)
    if key == "power.level":
        return f"{100.0 * value:.0f} %"
    degrees = f"  ({math.degrees(value):.0f} degrees)" if unit == "rad" else ""
    return f"{value + 0.0:.3f} {unit}".rstrip() + degrees
