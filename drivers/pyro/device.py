"""Devices of a robot in Pyro's interface: range sensors, bumpers, position, battery, head."""

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
"""Direction of a ranger by its name, in degrees; for other names the capability contains ``NAME_deg``."""
UNITS = ("ROBOTS", "METERS", "CM", "MM", "SCALED", "RAW")
ALIASES = {"M": "METERS", "ROBOT": "ROBOTS"}
DEFAULT_ARC_RAD = math.radians(20.0)
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
"""The right and the left edge of each group of sensors, in degrees."""


class Geometry(NamedTuple):
    """Position of a sensor on the robot (metres), its direction (radians, left positive), and its field of view."""

    x: float
    y: float
    z: float
    theta: float
    arc: float


class SensorValue:
    """One reading: ``metres`` from the sensor, or ``most``, the sensor's maximum, if nothing is in range.

    ``unit`` is the unit of ``value``; ``radius`` is the radius of the robot. ``noise`` is 0: no noise is added.
    """

    noise = 0.0

    def __init__(
        self, metres: float, most: float, pos: int, geometry: Geometry | None, radius: float, unit: str = "ROBOTS"
    ) -> None:
        self.rawValue = most if math.isnan(metres) else min(metres, most)
        self.pos = pos
        self.geometry = geometry
        self._max_metres = most
        self._radius = radius
        self._unit = unit

    @property
    def value(self) -> float:
        """The distance in the device's unit."""
        return self.distance()

    def distance(self, unit: str | None = None) -> float:
        """Return the distance in ``unit``: ``ROBOTS`` (diameters), ``METERS``, ``CM``, ``MM``, ``SCALED``, ``RAW``."""
        name = parse_unit(unit or self._unit)
        if name == "ROBOTS":
            return self.rawValue / (2.0 * self._radius)
        return self.rawValue * {"CM": 100.0, "MM": 1000.0, "SCALED": 1.0 / self._max_metres}.get(name, 1.0)

    def angle(self, unit: str = "degrees") -> float | None:
        """Return the direction of the sensor, left positive; None if it is unknown."""
        if unit.lower() not in ("degrees", "radians"):
            raise AttributeError(f"the unit of an angle is degrees or radians, not {unit!r}")
        if self.geometry is None:
            return None
        return math.degrees(self.geometry.theta) if unit.lower() == "degrees" else self.geometry.theta

    @property
    def hit(self) -> tuple[float | None, float | None, float | None]:
        """The measured point, in metres from the centre of the robot."""
        if self.geometry is None:
            return None, None, None
        x, y, z, theta, _ = self.geometry
        return x + self.rawValue * math.cos(theta), y + self.rawValue * math.sin(theta), z


def parse_unit(name: str) -> str:
    """Return the unit of this name; raise ``AttributeError`` that lists the known units."""
    upper = name.upper()
    found = ALIASES.get(upper, upper)
    if found not in UNITS:
        raise AttributeError(f"unknown unit {name!r}; known are {', '.join(UNITS)}")
    return found


class Device:
    """A device of ``type``; ``update`` gives the device the newest sensor values."""

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
        """Store the newest sensor values."""
        self.values, self.timestamp = values, now

    def getSensorValue(self, pos: int) -> SensorValue:
        """Return the reading of the sensor at ``pos``."""
        raise IndexError(f"the {self.type} has no sensor {pos}")

    def __len__(self) -> int:
        return 0


class SensorArray(Device):
    """A device with several sensors; ``places`` maps a key of an observation to the geometry of that sensor."""

    units = "ROBOTS"
    rawunits = "METERS"

    def __init__(self, kind: str, places: Mapping[str, Geometry | None], most: float, radius: float) -> None:
        super().__init__(kind)
        self.maxvalueraw = most
        self.radius = radius
        self._places = places
        self._keys: list[str] = []

    def update(self, values: Mapping[str, Value], now: float) -> None:
        """Store the newest sensor values; the sensors are numbered from the left."""
        super().update(values, now)
        self._keys = [key for key in self._places if key in values]

    def setUnits(self, name: str) -> None:
        """Set the unit of ``value``."""
        self.units = parse_unit(name)

    def getSensorValue(self, pos: int) -> SensorValue:
        """Return the reading of the sensor at ``pos``, from the left."""
        key = self._keys[pos]
        return SensorValue(float(self.values[key]), self.maxvalueraw, pos, self._places[key], self.radius, self.units)

    @property
    def groups(self) -> dict[str, tuple[int, ...]]:
        """The names of the groups, and the numbers of their sensors."""
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
                raise AttributeError(f"the {self.type} has no group {item!r}; known are all, {', '.join(GROUPS)}")
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
        """The numbers of the sensors."""
        return [one.pos for one in self]

    @property
    def geometry(self) -> list[Geometry | None]:
        """The geometry of each sensor."""
        return [one.geometry for one in self]

    @property
    def hit(self) -> list[tuple[float | None, float | None, float | None]]:
        """The measured points."""
        return [one.hit for one in self]

    @property
    def noise(self) -> list[float]:
        """The noise of each reading, always 0."""
        return [one.noise for one in self]

    def distance(self, unit: str | None = None) -> list[float]:
        """Return all distances in ``unit``."""
        return [one.distance(unit) for one in self]

    def angle(self, unit: str = "degrees") -> list[float | None]:
        """Return the direction of each sensor."""
        return [one.angle(unit) for one in self]

    def span(self, start: float, stop: float, units: str = "degrees") -> list[SensorValue]:
        """Return the sensors between two angles, which may be given in any order."""
        low, high = min(start, stop), max(start, stop)
        return [one for one in self if (angle := one.angle(units)) is not None and low <= angle <= high]


class Bumper(SensorArray):
    """The bumpers; ``value`` is 1 for a pressed bumper."""

    def getSensorValue(self, pos: int) -> SensorValue:
        """Return 1 if the bumper at ``pos``, from the left, is pressed, else 0."""
        key = self._keys[pos]
        return SensorValue(float(bool(self.values[key])), 1.0, pos, self._places[key], self.radius, "RAW")


class Battery(Device):
    """The battery: ``level`` from 0 to 1, and ``volts``; None if the robot does not report the value."""

    @property
    def level(self) -> float | None:
        """The charge."""
        return _to_number(self.values.get("power.level"))

    @property
    def volts(self) -> float | None:
        """The voltage."""
        return _to_number(self.values.get("power.volts"))


class Pose(NamedTuple):
    """Pan (-1 to 1, left positive), tilt (-1 to 0, down negative), zoom (unused), roll (0 to 1: second tilt joint)."""

    pan: float
    tilt: float
    zoom: float
    roll: float


AXES = {"pan": "pan", "tilt": "tilt", "roll": "nod"}
"""The robot's names of the axes, by their names in brains."""


class Ptz(Device):
    """A head; ``look`` turns joints to angles in radians within ``limits`` (``pan_min``, ``pan_max`` ...)."""

    supports = ("pan", "tilt", "roll")

    def __init__(self, look: Callable[[Mapping[str, float]], None], limits: Mapping[str, float | str]) -> None:
        super().__init__("ptz")
        self._look = look
        self._limits = limits

    def pan(self, share: float) -> None:
        """Turn left (to 1) or right (to -1)."""
        self._turn(pan=share)

    def tilt(self, share: float) -> None:
        """Tilt down (to -1) or ahead (0)."""
        self._turn(tilt=share)

    def roll(self, share: float) -> None:
        """Turn the second tilt joint."""
        self._turn(roll=share)

    def zoom(self, share: float) -> None:
        """Do nothing: the head has no zoom."""

    def center(self) -> None:
        """Turn ahead."""
        self._turn(pan=0.0, tilt=0.0, roll=0.0)

    def setPose(self, pan: float, tilt: float, zoom: float = 0.0, roll: float | None = None) -> None:
        """Set all axes together; the zoom is ignored."""
        self._turn(pan=pan, tilt=tilt, **({} if roll is None else {"roll": roll}))

    @property
    def pose(self) -> Pose:
        """The pose that the robot reports."""
        pose = {
            axis: self._to_share(joint, float(self.values.get(f"ptz.{joint}", 0.0))) for axis, joint in AXES.items()
        }
        return Pose(pose["pan"], pose["tilt"], 0.0, pose["roll"])

    def _turn(self, **shares: float) -> None:
        self._look({AXES[axis]: self._to_radians(AXES[axis], share) for axis, share in shares.items()})

    def _to_radians(self, joint: str, share: float) -> float:
        share = max(-1.0, min(1.0, share))
        return share * self._get_limit(joint, "max") if share > 0.0 else -share * self._get_limit(joint, "min")

    def _to_share(self, joint: str, radians: float) -> float:
        limit = self._get_limit(joint, "max") if radians > 0.0 else -self._get_limit(joint, "min")
        return max(-1.0, min(1.0, radians / limit)) if limit else 0.0

    def _get_limit(self, joint: str, end: str) -> float:
        return float(self._limits.get(f"{joint}_{end}", 0.0))


def make_ranger(description: Description, values: Mapping[str, Value]) -> SensorArray | None:
    """Return the range sensors of a robot; None if it has none.

    The device is named ``laser`` if it has more than four sensors, ``ir`` on a dog with a near and a far ranger, and
    otherwise ``sonar``.
    """
    capability = description.capabilities.get("ranger")
    names = [key.removeprefix("range.") for key in values if key.startswith("range.")]
    if capability is None or not names:
        return None
    most = capability.get("max", 1.0)
    kind = "laser" if len(names) > 4 else "ir" if "near" in names else "sonar"
    angles = {name: capability.get(f"{name}_deg", DIRECTIONS.get(name, math.nan)) for name in names}
    known = {name: math.radians(float(angle)) for name, angle in angles.items() if angle == angle}
    names.sort(key=lambda name: (-known.get(name, -math.inf), list(values).index(f"range.{name}")))
    places = {f"range.{name}": _make_geometry(known.get(name), description.radius) for name in names}
    return SensorArray(kind, places, float(most), description.radius)


def make_bumper(description: Description, values: Mapping[str, Value]) -> Bumper | None:
    """Return the bumpers of a robot; None if it has none."""
    names = [key.removeprefix("bump.") for key in values if key.startswith("bump.")]
    if not names:
        return None
    angles = {name: math.radians(DIRECTIONS[name]) for name in names if name in DIRECTIONS}
    names.sort(key=lambda name: -angles.get(name, -math.inf))
    places = {f"bump.{name}": _make_geometry(angles.get(name), description.radius) for name in names}
    return Bumper("bumper", places, 1.0, description.radius)


def _make_geometry(theta: float | None, radius: float) -> Geometry | None:
    return (
        None
        if theta is None
        else Geometry(radius * math.cos(theta), radius * math.sin(theta), 0.0, theta, DEFAULT_ARC_RAD)
    )


def _is_within(angle: float | None, low: float, high: float) -> bool:
    if angle is None:
        return False
    return low <= angle <= high or low <= angle + 360.0 <= high


def _to_number(value: Value | None) -> float | None:
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else None
