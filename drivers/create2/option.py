"""Options of the kind "create2": read from a free table and checked, each fault with its remedy."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Literal

from msgspec import Meta

from drivers.option import Device, convert_options
from drivers.reading import Description

Baud = Literal[57600, 115200]
"""A slower line does not carry a frame in the 15 ms after which the robot sends the next."""
Mode = Literal["safe", "full"]
"""The robot stops at cliffs by itself (safe), or does not (full)."""
SKILLS = ("dock", "beep")


@dataclass(frozen=True)
class Options:
    """The serial device and its speed, the mode that ``enable`` asks for, and limits of speed in m/s and rad/s."""

    port: Device
    baud: Baud = 115200
    mode: Mode = "safe"
    max_speed: Annotated[float, Meta(gt=0, le=0.5)] = 0.5
    max_turn: Annotated[float, Meta(gt=0, le=4.25)] = 4.25


def checked(table: Mapping[str, object]) -> Options:
    """The options in ``table``; raises ``UsageError`` that names the key and what to write instead."""
    return convert_options("create2", table, Options)


def described(options: Options) -> Description:
    """What a Create 2 is, known without a connection."""
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
