"""The initial state of a simulated world, read from JSON and checked.

Lengths are in metres, angles in degrees in the file and in radians here; the origin is the lower left corner.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

FOOTPRINT = 0.12
"""Radius of the circle that an ERS-7 occupies on the floor, in metres."""
MAX_STRIPES = 5


class SceneError(ValueError):
    """The scene is invalid; the message names the file, the key and the remedy."""


@dataclass(frozen=True)
class Kennel:
    """Initial pose of one dog, and the number of yellow ``stripes`` on its head, which distinguish it."""

    name: str
    x: float
    y: float
    heading: float
    stripes: int


@dataclass(frozen=True)
class Scene:
    """A walled rectangle of ``width`` by ``height`` with dogs; the target is placed later, on demand."""

    name: str
    width: float
    height: float
    wall_height: float
    target_radius: float
    target_height: float
    kennels: tuple[Kennel, ...]


def scene_names() -> list[str]:
    """Return the installed scenes."""
    folder = resources.files("sim.robots") / "scenes"
    return sorted(item.name.removesuffix(".json") for item in folder.iterdir() if item.name.endswith(".json"))


def loaded(name: str) -> Scene:
    """Load the installed scene ``name``, or the file ``name`` if it ends with ``.json``."""
    if name.endswith(".json"):
        try:
            text = Path(name).read_text(encoding="utf-8")
        except OSError as error:
            raise SceneError(f"scene {name}: cannot be read ({error.strerror}); check the path") from error
        except UnicodeDecodeError as error:
            raise SceneError(f"scene {name}: is not UTF-8 text; convert the file") from error
        return parsed(text, name)
    if name not in scene_names():
        raise SceneError(
            f"unknown scene {name!r}; known are {', '.join(scene_names())}, or give the path of a .json file"
        )
    return parsed((resources.files("sim.robots") / "scenes" / f"{name}.json").read_text(encoding="utf-8"), name)


def parsed(text: str, source: str) -> Scene:
    """Parse the scene in the JSON ``text``; ``source`` names it in errors."""
    try:
        fields = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise SceneError(f"scene {source}: is not JSON ({error})") from error
    top = _Table(fields, f"scene {source}")
    width, height = top.number("width", 1.0, 100.0), top.number("height", 1.0, 100.0)
    target = _Table(top.fields.get("target", {}), f"scene {source}, target")
    entries = top.fields.get("dogs")
    if not isinstance(entries, list) or not entries:
        raise SceneError(f"scene {source}: dogs must be a list with at least one dog")
    kennels = tuple(
        _kennel(_Table(entry, f"scene {source}, dog {place}"), width, height) for place, entry in enumerate(entries, 1)
    )
    _check_apart(kennels, source)
    return Scene(
        name=top.text("name"),
        width=width,
        height=height,
        wall_height=top.number("wall_height", 0.05, 2.0),
        target_radius=target.number("radius", 0.02, 0.3),
        target_height=target.number("height", 0.05, 1.0),
        kennels=kennels,
    )


def _kennel(table: _Table, width: float, height: float) -> Kennel:
    stripes = table.number("stripes", 1, MAX_STRIPES)
    return Kennel(
        name=table.text("name"),
        x=table.number("x", FOOTPRINT, width - FOOTPRINT),
        y=table.number("y", FOOTPRINT, height - FOOTPRINT),
        heading=math.radians(table.number("heading_deg", -360.0, 360.0)),
        stripes=int(stripes),
    )


def _check_apart(kennels: tuple[Kennel, ...], source: str) -> None:
    for place, one in enumerate(kennels):
        for other in kennels[:place]:
            if one.name == other.name:
                raise SceneError(f"scene {source}: two dogs are named {one.name}; give each its own name")
            if math.hypot(one.x - other.x, one.y - other.y) < 2 * FOOTPRINT:
                raise SceneError(
                    f"scene {source}: {other.name} and {one.name} overlap; put them {2 * FOOTPRINT} m apart"
                )


class _Table:
    """A JSON object with typed access to its fields, and errors that name the position."""

    def __init__(self, fields: object, where: str) -> None:
        if not isinstance(fields, Mapping):
            raise SceneError(f"{where}: must be an object {{...}}")
        self.fields: Mapping[str, object] = fields
        self._where = where

    def number(self, key: str, lowest: float, highest: float) -> float:
        value = self.fields.get(key)
        if not isinstance(value, (int, float)) or isinstance(value, bool) or not lowest <= value <= highest:
            raise SceneError(f"{self._where}: {key} must be a number from {lowest:g} to {highest:g}, not {value!r}")
        return float(value)

    def text(self, key: str) -> str:
        value = self.fields.get(key)
        if not isinstance(value, str) or not 1 <= len(value) <= 32:
            raise SceneError(f"{self._where}: {key} must be a text of 1 to 32 characters, not {value!r}")
        return value
