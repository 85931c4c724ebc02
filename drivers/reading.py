"""Values that pass through a driver: observations, actions, and the description of both.

Units are SI, x forward, y left, counter-clockwise positive.  Keys are flat (``base.vx``, ``range.near``,
``imu.az``); ``Description`` lists the keys that a robot has and their limits, before a connection exists.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

Value = float | bool | str
Action = Mapping[str, float]
"""A command to a robot: keys of ``Description.limits`` to values; a missing key means "unchanged"."""


@dataclass(frozen=True)
class Frame:
    """One camera picture.

    ``data`` is a complete JPEG; ``seq`` counts frames, including dropped ones; ``t_robot`` is in seconds of the
    robot's clock.
    """

    seq: int
    width: int
    height: int
    data: bytes
    t_robot: float
    encoding: str = "jpeg"


@dataclass(frozen=True)
class Observation:
    """The newest known state of a robot.

    ``values`` maps flat keys to SI values (NaN: nothing in range). ``samples`` maps a key to the samples since the
    previous frame, oldest first; the ERS-7 delivers 4 samples every 32 ms.  ``t_host`` is the time of arrival on the
    driver's clock, ``t_robot`` the time on the robot's clock, both in seconds.
    """

    t_host: float
    t_robot: float
    values: Mapping[str, Value]
    samples: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    frame: Frame | None = None


@dataclass(frozen=True)
class Description:
    """The properties and abilities of a robot, known without a connection.

    ``capabilities`` maps a capability name (``base2d``, ``ranger``, ``camera``, ``imu``, ``odometry``, ``power``) to
    its properties, which are numbers or text: ``ranger`` has ``max`` in metres, ``camera`` has ``width``, ``height``
    and ``fps``. ``limits`` maps each action key to its lowest and highest value. ``radius`` is in metres, ``rates``
    are in Hz. ``skills`` are the names that ``invoke`` accepts.
    """

    kind: str
    model: str
    capabilities: Mapping[str, Mapping[str, float | str]]
    limits: Mapping[str, tuple[float, float]]
    radius: float
    rates: Mapping[str, float] = field(default_factory=dict)
    skills: tuple[str, ...] = ()
