"""SensorValue: one reading of a range sensor, in the units that brains ask for."""

from __future__ import annotations

import math
from typing import NamedTuple

UNITS = ("ROBOTS", "METERS", "CM", "MM", "SCALED", "RAW")
ALIASES = {"M": "METERS", "ROBOT": "ROBOTS"}


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
