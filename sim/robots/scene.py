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

FOOTPRINT_RADIUS_M = 0.12
"""Radius of the circle that an ERS-7 occupies on the floor, in metres."""
MAX_STRIPES = 5


class SceneError(ValueError):
    """The scene is invalid; the message contains the file, the key and the remedy."""


@dataclass(frozen=True)
class DogPlacement:
    """Initial pose of one dog, and the number of yellow ``stripes`` on its head, which distinguish the dogs."""

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
    dogs: tuple[DogPlacement, ...]


def list_scenes() -> list[str]:
    """Return the installed scenes."""
    folder = resources.files("sim.robots") / "scenes"
    return sorted(item.name.removesuffix(".json") for item in folder.iterdir() if item.name.endswith(".json"))


def load_scene(name: str) -> Scene:
    """Load the installed scene ``name``, or the file ``name`` if it ends with ``.json``."""
    if name.endswith(".json"):
        try:
            text = Path(name).read_text(encoding="utf-8")
        except OSError as error:
            raise SceneError(f"scene {name}: cannot be read ({error.strerror}); check the path") from error
        except UnicodeDecodeError as error:
            raise SceneError(f"scene {name}: is not UTF-8 text; convert the file") from error
        return parse_scene(text, name)
    if name not in list_scenes():
        raise SceneError(
            f"unknown scene {name!r}; known are {', '.join(list_scenes())}, or give the path of a .json file"
        )
    return parse_scene((resources.files("sim.robots") / "scenes" / f"{name}.json").read_text(encoding="utf-8"), name)


def parse_scene(text: str, source: str) -> Scene:
    """Parse the scene in the JSON ``text``; errors contain ``source`` as its name."""
    try:
        fields = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise SceneError(f"scene {source}: is not JSON ({error})") from error
    top = _Table(fields, f"scene {source}")
    width, height = top.read_number("width", 1.0, 100.0), top.read_number("height", 1.0, 100.0)
    target = _Table(top.fields.get("target", {}), f"scene {source}, target")
    entries = top.fields.get("dogs")
    if not isinstance(entries, list) or not entries:
        raise SceneError(f"scene {source}: dogs must be a list with at least one dog")
    placements = tuple(
        _parse_dog(_Table(entry, f"scene {source}, dog {place}"), width, height)
        for place, entry in enumerate(entries, 1)
    )
    _check_apart(placements, source)
    return Scene(
        name=top.read_text("name"),
        width=width,
        height=height,
        wall_height=top.read_number("wall_height", 0.05, 2.0),
        target_radius=target.read_number("radius", 0.02, 0.3),
        target_height=target.read_number("height", 0.05, 1.0),
        dogs=placements,
    )


def _parse_dog(table: _Table, width: float, height: float) -> DogPlacement:
    stripes = table.read_number("stripes", 1, MAX_STRIPES)
    return DogPlacement(
        name=table.read_text("name"),
        x=table.read_number("x", FOOTPRINT_RADIUS_M, width - FOOTPRINT_RADIUS_M),
        y=table.read_number("y", FOOTPRINT_RADIUS_M, height - FOOTPRINT_RADIUS_M),
        heading=math.radians(table.read_number("heading_deg", -360.0, 360.0)),
        stripes=int(stripes),
    )


def _check_apart(placements: tuple[DogPlacement, ...], source: str) -> None:
    for place, one in enumerate(placements):
        for other in placements[:place]:
            if one.name == other.name:
                raise SceneError(f"scene {source}: two dogs are named {one.name}; give each its own name")
            if math.hypot(one.x - other.x, one.y - other.y) < 2 * FOOTPRINT_RADIUS_M:
                raise SceneError(
                    f"scene {source}: {other.name} and {one.name} overlap; put them {2 * FOOTPRINT_RADIUS_M} m apart"
                )


class _Table:
    """A JSON object with typed access to its fields; errors contain the location of the object in the file."""

    def __init__(self, fields: object, where: str) -> None:
        if not isinstance(fields, Mapping):
            raise SceneError(f"{where}: must be an object {{...}}")
        self.fields: Mapping[str, object] = fields
        self._where = where

    def read_number(self, key: str, lowest: float, highest: float) -> float:
        value = self.fields.get(key)
        if not isinstance(value, (int, float)) or isinstance(value, bool) or not lowest <= value <= highest:
            raise SceneError(f"{self._where}: {key} must be a number from {lowest:g} to {highest:g}, not {value!r}")
        return float(value)

    def read_text(self, key: str) -> str:
        value = self.fields.get(key)
        if not isinstance(value, str) or not 1 <= len(value) <= 32:
            raise SceneError(f"{self._where}: {key} must be a string of 1 to 32 characters, not {value!r}")
        return value
