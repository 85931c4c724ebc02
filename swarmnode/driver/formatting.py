"""Text for descriptions of robots, and for readings with their units."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from drivers.reading import Description

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
"""Prefixes of keys with the SI unit of their values; the first match applies."""


def get_unit(key: str) -> str:
    """Return the unit of a key's values; empty for shares, booleans and text."""
    if key.startswith("joint.") and key.endswith(".pos"):
        return "rad"
    return next((unit for starts, unit in UNITS if key.startswith(starts)), "")


def format_reading(key: str, value: object) -> str:
    """Return a reading as text with its unit; an angle in degrees as well."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, str):
        return value or "-"
    if not isinstance(value, float | int):
        return repr(value)
    if math.isnan(value):
        return "nothing in range" if key.startswith("range.") else "unknown"
    unit = get_unit(key)
    if key == "power.level":
        return f"{100.0 * value:.0f} %"
    degrees = f"  ({math.degrees(value):.0f} degrees)" if unit == "rad" else ""
    return f"{value + 0.0:.3f} {unit}".rstrip() + degrees


def make_json_safe(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return readings for JSON; NaN and infinities become None."""
    return {
        key: None if isinstance(value, float) and not math.isfinite(value) else value for key, value in values.items()
    }


def format_description(body: Description) -> Iterator[str]:
    """Return the description as a table."""
    yield f"{body.kind}: {body.model}"
    yield f"{'radius':14}{body.radius:g} m"
    yield from _format_rows(
        "capabilities", {name: _format_properties(about) for name, about in body.capabilities.items()}
    )
    limits = {
        key: f"{low:+.3g} to {high:+.3g} {get_unit(key)}".rstrip() for key, (low, high) in sorted(body.limits.items())
    }
    yield from _format_rows("limits", limits or {"none": "it accepts no motion commands"})
    yield from _format_rows("rates", {name: f"{rate:g} per second" for name, rate in body.rates.items()})
    yield from _wrap_words("skills", body.skills or ("none",))


def _format_properties(about: Mapping[str, float | str]) -> str:
    return ", ".join(
        f"{key} {value:g}" if isinstance(value, float | int) else f"{key} {value}" for key, value in about.items()
    )


def _format_rows(title: str, rows: Mapping[str, str]) -> Iterator[str]:
    width = max(map(len, rows), default=0)
    for number, (name, text) in enumerate(rows.items()):
        yield f"{title if number == 0 else '':14}{name:{width}}  {text}".rstrip()


def _wrap_words(title: str, words: tuple[str, ...], width: int = 90) -> Iterator[str]:
    row = ""
    for word in words:
        if row and len(row) + len(word) > width:
            yield f"{title:14}{row.rstrip()}"
            title, row = "", ""
        row += word + " "
    yield f"{title:14}{row.rstrip()}"
