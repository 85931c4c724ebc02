"""Options of the kind "create2"; each error says how to correct it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Literal

from msgspec import Meta

from drivers.option import Device, convert_options
from drivers.reading import Description

Baud = Literal[57600, 115200]
"""The supported baud rates; slower lines cannot transmit a frame within the robot's interval of 15 ms."""
Mode = Literal["safe", "full"]
"""In ``safe`` mode the robot stops at cliffs by itself, in ``full`` mode it does not."""
SKILLS = ("dock", "beep")


@dataclass(frozen=True)
class Options:
    """The serial device and its speed, the mode that ``enable`` selects, and speed limits in m/s and rad/s."""

    port: Device
    baud: Baud = 115200
    mode: Mode = "safe"
    max_speed: Annotated[float, Meta(gt=0, le=0.5)] = 0.5
    max_turn: Annotated[float, Meta(gt=0, le=4.25)] = 4.25


def parse_options(table: Mapping[str, object]) -> Options:
    """Convert and check ``table``; raise ``UsageError`` with the key, the problem and the remedy."""
    return convert_options("create2", table, Options)


def make_description(options: Options) -> Description:
    """Return the description of a Create 2."""
    return Description(
        kind="create2",
        model="iRobot Create 2",
        capabilities={
            "base2d": {},
            "odometry": {},
            "bumper": {},
            "cliff": {},
            "wheeldrop": {},
            "lightbump": {},
            "buttons": {},
            "power": {},
            "mode": {},
            "estop": {},
            "sound": {},
            "skill": {},
        },
        limits={
            "base.vx": (-options.max_speed, options.max_speed),
            "base.wz": (-options.max_turn, options.max_turn),
        },
        radius=0.174,
        rates={"state": 1000.0 / 15.0},
        skills=SKILLS,
    )
