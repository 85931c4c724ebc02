"""Device: what a robot has, as brains know it: range sensors, bumpers, a position, a battery, a head."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from typing import NamedTuple, overload

from drivers.reading import Description, Value

DIRECTIONS: Mapping[str, float] = {
    **dict.fromkeys(("near", "far", "front"), 0.0),
    **{"front_left": 45.0, "left": 90.0, "back_left": 135.0, "back": 180.0},
    **{"back_right": -135.0, "right": -90.0, "front_right": -45.0},
}
"""Where a ranger of this name looks, in degrees; one of another name where its capability says ``NAME_deg``."""
UNITS = ("ROBOTS", "METERS", "CM", "MM", "SCALED", "RAW")
ALIASES = {"M": "METERS", "ROBOT": "ROBOTS"}
ARC = math.radians(20.0)
GROUPS: Mapping[str, tuple[float, float]] = {
    "front": (-22.5, 22.5),
    "front-left": (22.5, 67.5),
    "front-right": (-67.5, -22.5),
    "front-all": (-67.5, 67.5),
    "left": (67.5, 112.5),
    "right": (-112.5, -67.5),
    "left-front": (45.0, 90.0),
    "right-front": (-90.0, -45.0),
    "left-back": (90.0, 135.0),
    "right-back": (-135.0, -90.0),
    "back-left": (112.5, 157.5),
    "back-right": (-157.5, -112.5),
    "back": (157.5, 202.5),
    "back-all": (112.5, 247.5),
}
"""Degrees from the right edge of a group to its left edge."""


class Geometry(NamedTuple):
    """Where a sensor sits on the robot (metres), where it looks (radians, left positive), and how wide it sees."""

    x: float
    y: float
    z: float
    theta: float
    arc: float


class SensorValue:
    """One reading: ``metres`` from the sensor; where nothing is in reach that is ``most``, the farthest it measures.

    ``unit`` is the one of ``value``; ``radius`` is the robot's.  ``noise`` is 0: what is told is what was measured.
    """

    noise = 0.0

    def __init__(
        self, metres: float, most: float, pos: int, geometry: Geometry | None, radius: float, unit: str = "ROBOTS"
    ) -> None:
        self.rawValue = most if math.isnan(metres) else min(metres, most)
        self.pos = pos
        self.geometry = geometry
        self._most = most
        self._radius = radius
        self._unit = unit

    @property
    def value(self) -> float:
        """The distance in the device's unit."""
        return self.distance()

    def distance(self, unit: str | None = None) -> float:
        """The distance in ``unit``: ``ROBOTS`` (robots' diameters), ``METERS``, ``CM``, ``MM``, ``SCALED``, ``RAW``."""
        name = unit_named(unit or self._unit)
        if name == "ROBOTS":
            return self.rawValue / (2.0 * self._radius)
        return self.rawValue * {"CM": 100.0, "MM": 1000.0, "SCALED": 1.0 / self._most}.get(name, 1.0)

    def angle(self, unit: str = "degrees") -> float | None:
        """Where it looks, left positive; None where nobody knows."""
        if unit.lower() not in ("degrees", "radians"):
            raise AttributeError(f"an angle is in degrees or radians, not in {unit!r}")
        if self.geometry is None:
            return None
        return math.degrees(self.geometry.theta) if unit.lower() == "degrees" else self.geometry.theta

    @property
    def hit(self) -> tuple[float | None, float | None, float | None]:
        """The point that it measured, in metres from the middle of the robot."""
        if self.geometry is None:
            return None, None, None
        x, y, z, theta, _ = self.geometry
        return x + self.rawValue * math.cos(theta), y + self.rawValue * math.sin(theta), z


def unit_named(name: str) -> str:
    """The unit called so; raises ``AttributeError``, which names those there are."""
    upper = name.upper()
    found = ALIASES.get(upper, upper)
    if found not in UNITS:
        raise AttributeError(f"no unit is called {name!r}; there are {', '.join(UNITS)}")
    return found


class Device:
    """A device of ``type``; ``update`` gives it what the robot feels now."""

    def __init__(self, kind: str) -> None:
        self.type = kind
        self.title = kind
        self.index = 0
        self.active = 1
        self.visible = 0
        self.state = "started"
        self.timestamp = 0.0
        self.values: Mapping[str, Value] = {}

    def update(self, values: Mapping[str, Value], now: float) -> None:
        """Take in what the robot feels."""
        self.values, self.timestamp = values, now

    def getSensorValue(self, pos: int) -> SensorValue:
        """The reading of the sensor at ``pos``."""
        raise IndexError(f"the {self.type} has no sensor {pos}")

    def __len__(self) -> int:
        return 0


class Rows(Device):
    """A device of several sensors; ``places`` maps a key of an observation to where the sensor is."""

    units = "ROBOTS"
    rawunits = "METERS"

    def __init__(self, kind: str, places: Mapping[str, Geometry | None], most: float, radius: float) -> None:
        super().__init__(kind)
        self.maxvalueraw = most
        self.radius = radius
        self._places = places
        self._keys: list[str] = []

    def update(self, values: Mapping[str, Value], now: float) -> None:
        """Take in what the robot feels; its sensors count from the left."""
        super().update(values, now)
        self._keys = [key for key in self._places if key in values]

    def setUnits(self, name: str) -> None:
        """Have ``value`` in this unit from now on."""
        self.units = unit_named(name)

    def getSensorValue(self, pos: int) -> SensorValue:
        """The reading of the sensor at ``pos``, from the left."""
        key = self._keys[pos]
        return SensorValue(float(self.values[key]), self.maxvalueraw, pos, self._places[key], self.radius, self.units)

    @property
    def groups(self) -> dict[str, tuple[int, ...]]:
        """The names of groups of sensors, and which these are."""
        found = {"all": tuple(range(len(self)))}
        for name, (low, high) in GROUPS.items():
            found[name] = tuple(one.pos for one in self if _is_within(one.angle(), low, high))
        return found

    @overload
    def __getitem__(self, item: int) -> SensorValue: ...

    @overload
    def __getitem__(self, item: slice | tuple[int, ...] | str) -> list[SensorValue]: ...

    def __getitem__(self, item: int | slice | tuple[int, ...] | str) -> SensorValue | list[SensorValue]:
        if isinstance(item, int):
            return self.getSensorValue(item)
        if isinstance(item, slice):
            return [self.getSensorValue(pos) for pos in range(len(self))[item]]
        if isinstance(item, str):
            if item not in GROUPS and item != "all":
                raise AttributeError(f"the {self.type} has no group {item!r}; there are all, {', '.join(GROUPS)}")
            item = self.groups[item]
        return [self.getSensorValue(pos) for pos in item]

    def __iter__(self) -> Iterator[SensorValue]:
        return (self.getSensorValue(pos) for pos in range(len(self)))

    def __len__(self) -> int:
        return len(self._keys)

    @property
    def value(self) -> list[float]:
        """All readings in the device's unit, from the left."""
        return [one.value for one in self]

    @property
    def rawValue(self) -> list[float]:
        """All readings in metres."""
        return [one.rawValue for one in self]

    @property
    def pos(self) -> list[int]:
        """The places in the row."""
        return [one.pos for one in self]

    @property
    def geometry(self) -> list[Geometry | None]:
        """Where each is."""
        return [one.geometry for one in self]

    @property
    def hit(self) -> list[tuple[float | None, float | None, float | None]]:
        """The points that were measured."""
        return [one.hit for one in self]

    @property
    def noise(self) -> list[float]:
        """None is added."""
        return [one.noise for one in self]

    def distance(self, unit: str | None = None) -> list[float]:
        """All distances in ``unit``."""
        return [one.distance(unit) for one in self]

    def angle(self, unit: str = "degrees") -> list[float | None]:
        """Where each looks."""
        return [one.angle(unit) for one in self]

    def span(self, start: float, stop: float, units: str = "degrees") -> list[SensorValue]:
        """Those that look between two angles, whichever is the left one."""
        low, high = min(start, stop), max(start, stop)
        return [one for one in self if (angle := one.angle(units)) is not None and low <= angle <= high]


class Bumper(Rows):
    """The bumpers; ``value`` is 1 where one is pressed."""

    def getSensorValue(self, pos: int) -> SensorValue:
        """Whether the bumper at ``pos``, from the left, is pressed: 1 or 0."""
        key = self._keys[pos]
        return SensorValue(float(bool(self.values[key])), 1.0, pos, self._places[key], self.radius, "RAW")


class Battery(Device):
    """The battery: ``level`` 0 to 1, ``volts``; None where the robot does not say."""

    @property
    def level(self) -> float | None:
        """The charge."""
        return _number(self.values.get("power.level"))

    @property
    def volts(self) -> float | None:
        """The voltage."""
        return _number(self.values.get("power.volts"))


class Pose(NamedTuple):
    """Pan (-1 to 1, left positive), tilt (-1 to 0, down negative), zoom (none), roll (0 to 1: the second tilt)."""

    pan: float
    tilt: float
    zoom: float
    roll: float


AXES = {"pan": "pan", "tilt": "tilt", "roll": "nod"}
"""What the brain calls it, and what the robot does."""


class Ptz(Device):
    """A head; ``look`` turns joints to radians, ``limits`` are those of the robot (``pan_min``, ``pan_max`` ...)."""

    supports = ("pan", "tilt", "roll")

    def __init__(self, look: Callable[[Mapping[str, float]], None], limits: Mapping[str, float | str]) -> None:
        super().__init__("ptz")
        self._look = look
        self._limits = limits

    def pan(self, share: float) -> None:
        """Look to the left (to 1) or to the right (to -1)."""
        self._turn(pan=share)

    def tilt(self, share: float) -> None:
        """Look down (to -1) or ahead (0)."""
        self._turn(tilt=share)

    def roll(self, share: float) -> None:
        """Turn the second tilt."""
        self._turn(roll=share)

    def zoom(self, share: float) -> None:
        """There is none."""

    def center(self) -> None:
        """Look ahead."""
        self._turn(pan=0.0, tilt=0.0, roll=0.0)

    def setPose(self, pan: float, tilt: float, zoom: float = 0.0, roll: float | None = None) -> None:
        """Turn all at once; the zoom is ignored."""
        self._turn(pan=pan, tilt=tilt, **({} if roll is None else {"roll": roll}))

    @property
    def pose(self) -> Pose:
        """Where the robot says that it looks."""
        told = {axis: self._share(joint, float(self.values.get(f"ptz.{joint}", 0.0))) for axis, joint in AXES.items()}
        return Pose(told["pan"], told["tilt"], 0.0, told["roll"])

    def _turn(self, **shares: float) -> None:
        self._look({AXES[axis]: self._radians(AXES[axis], share) for axis, share in shares.items()})

    def _radians(self, joint: str, share: float) -> float:
        share = max(-1.0, min(1.0, share))
        return share * self._limit(joint, "max") if share > 0.0 else -share * self._limit(joint, "min")

    def _share(self, joint: str, radians: float) -> float:
        limit = self._limit(joint, "max") if radians > 0.0 else -self._limit(joint, "min")
        return max(-1.0, min(1.0, radians / limit)) if limit else 0.0

    def _limit(self, joint: str, end: str) -> float:
        return float(self._limits.get(f"{joint}_{end}", 0.0))


def ranger_of(description: Description, values: Mapping[str, Value]) -> Rows | None:
    """The range sensors that a robot has; None without any.

    They are called ``laser`` where there are many, ``ir`` on a dog that has a near and a far one, else ``sonar``.
    """
    told = description.capabilities.get("ranger")
    names = [key.removeprefix("range.") for key in values if key.startswith("range.")]
    if told is None or not names:
        return None
    most = told.get("max", 1.0)
    kind = "laser" if len(names) > 4 else "ir" if "near" in names else "sonar"
    angles = {name: told.get(f"{name}_deg", DIRECTIONS.get(name, math.nan)) for name in names}
    known = {name: math.radians(float(angle)) for name, angle in angles.items() if angle == angle}
    names.sort(key=lambda name: (-known.get(name, -math.inf), list(values).index(f"range.{name}")))
    places = {f"range.{name}": _on_hull(known.get(name), description.radius) for name in names}
    return Rows(kind, places, float(most), description.radius)


def bumper_of(description: Description, values: Mapping[str, Value]) -> Bumper | None:
    """The bumpers that a robot has; None without any."""
    names = [key.removeprefix("bump.") for key in values if key.startswith("bump.")]
    if not names:
        return None
    angles = {name: math.radians(DIRECTIONS[name]) for name in names if name in DIRECTIONS}
    names.sort(key=lambda name: -angles.get(name, -math.inf))
    places = {f"bump.{name}": _on_hull(angles.get(name), description.radius) for name in names}
    return Bumper("bumper", places, 1.0, description.radius)


def _on_hull(theta: float | None, radius: float) -> Geometry | None:
    return None if theta is None else Geometry(radius * math.cos(theta), radius * math.sin(theta), 0.0, theta, ARC)


def _is_within(angle: float | None, low: float, high: float) -> bool:
    if angle is None:
        return False
    return low <= angle <= high or low <= angle + 360.0 <= high


def _number(value: Value | None) -> float | None:
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else None
