"""The few velocities of a Bittle, and the selection of the gait nearest to a requested velocity."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

STAND = "up"
MIN_SPEED_MPS, MIN_TURN_RADPS = 0.02, 0.1
"""Minimum requested speeds in m/s and rad/s; if both are lower, the robot stands."""


class Velocity(NamedTuple):
    """Forward speed in m/s and turn rate to the left in rad/s."""

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
"""Approximate velocity of each skill on a smooth floor; the options may contain measured values instead."""


def select_gait(vx: float, wz: float, gaits: Mapping[str, Velocity]) -> tuple[str, Velocity]:
    """Return the skill nearest to the requested velocity, and its real velocity.

    Even a slow requested velocity selects a moving gait. A gait that moves in an unrequested direction is never
    selected; if no gait is suitable, the robot stands.
    """
    vx = 0.0 if abs(vx) < MIN_SPEED_MPS else vx
    wz = 0.0 if abs(wz) < MIN_TURN_RADPS else wz
    fitting = {
        name: one
        for name, one in gaits.items()
        if one != REST and _is_compatible(one.vx, vx) and _is_compatible(one.wz, wz)
    }
    if not fitting:
        return STAND, REST
    speed = max(abs(one.vx) for one in gaits.values()) or 1.0
    turn = max(abs(one.wz) for one in gaits.values()) or 1.0
    name = min(fitting, key=lambda one: math.hypot((gaits[one].vx - vx) / speed, (gaits[one].wz - wz) / turn))
    return name, gaits[name]


def _is_compatible(real: float, requested: float) -> bool:
    return real == 0.0 or real * requested > 0.0
