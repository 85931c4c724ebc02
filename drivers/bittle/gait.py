"""Gait: the few velocities that a Bittle has; which of them is nearest to one that is wished for."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

STAND = "up"
LEAST_SPEED, LEAST_TURN = 0.02, 0.1
"""Whoever wishes for less, in m/s and rad/s, wishes to stand."""


class Velocity(NamedTuple):
    """Metres a second ahead, radians a second to the left."""

    vx: float
    wz: float


REST = Velocity(0.0, 0.0)
GAITS: Mapping[str, Velocity] = {
    "wkF": Velocity(0.08, 0.0),
    "trF": Velocity(0.15, 0.0),
    "bk": Velocity(-0.05, 0.0),
    "wkL": Velocity(0.06, 0.4),
    "wkR": Velocity(0.06, -0.4),
    "vtL": Velocity(0.0, 0.5),
    "vtR": Velocity(0.0, -0.5),
}
"""Skill to what it does on a smooth floor, roughly; each robot's own are measured, and written into its options."""


def chosen(vx: float, wz: float, gaits: Mapping[str, Velocity]) -> tuple[str, Velocity]:
    """The skill that comes nearest, and what it does.

    A robot that shall move does move, however slowly it shall; but none goes where it shall not: to stand is better.
    """
    vx = 0.0 if abs(vx) < LEAST_SPEED else vx
    wz = 0.0 if abs(wz) < LEAST_TURN else wz
    fitting = {name: one for name, one in gaits.items() if one != REST and _agree(one.vx, vx) and _agree(one.wz, wz)}
    if not fitting:
        return STAND, REST
    speed = max(abs(one.vx) for one in gaits.values()) or 1.0
    turn = max(abs(one.wz) for one in gaits.values()) or 1.0
    name = min(fitting, key=lambda one: math.hypot((gaits[one].vx - vx) / speed, (gaits[one].wz - wz) / turn))
    return name, gaits[name]


def _agree(real: float, wished: float) -> bool:
    return real == 0.0 or real * wished > 0.0
