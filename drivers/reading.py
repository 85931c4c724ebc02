"""What goes through a driver: observations up, actions down, and the description of both.

Units are SI, x forward, y left, counter-clockwise positive.  Keys are flat (``base.vx``, ``range.near``,
``imu.az``); ``Description`` says which a robot has and within which limits, before it is connected.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

Value = float | bool | str
Action = Mapping[str, float]
"""What a robot shall do: keys of ``Description.limits`` to values; a missing key means "unchanged"."""


@dataclass(frozen=True)
class Frame:
    """One camera picture.

    ``data`` is a whole JPEG; ``seq`` counts frames (gaps are dropped frames); ``t_robot`` is in robot seconds.
    """

    seq: int
    width: int
    height: int
    data: bytes
    t_robot: float
    encoding: str = "jpeg"


@dataclass(frozen=True)
class Observation:
    """The newest that is known of a robot.

    ``values`` maps flat keys to SI values (NaN: nothing in range); ``samples`` maps a key to the samples since the
    frame before, oldest first (the ERS-7 delivers 4 each 32 ms).  ``t_host`` is the moment of arrival on the
    driver's clock.
    """

    t_host: float
    t_robot: float
    values: Mapping[str, Value]
    samples: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    frame: Frame | None = None


@dataclass(frozen=True)
class Description:
    """What a robot is and can do, known without connecting to it.

    ``capabilities`` maps a capability name (``base2d``, ``ranger``, ``camera``, ``imu``, ``odometry``, ``power``) to
    its properties (numbers or text; ``ranger`` has ``max`` in metres, ``camera`` has ``width``, ``height``, ``fps``);
    ``limits`` maps each action key to its lowest and highest value; ``skills`` are the names that ``invoke`` knows.
    """

    kind: str
    model: str
    capabilities: Mapping[str, Mapping[str, float | str]]
    limits: Mapping[str, tuple[float, float]]
    radius: float
    rates: Mapping[str, float] = field(default_factory=dict)
    skills: tuple[str, ...] = ()
