"""Options of the kind "create2": read from a free table and checked, each fault with its remedy."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from drivers.errors import UsageError
from drivers.reading import Description

BAUDS = (57600, 115200)
"""A slower line does not carry a frame in the 15 ms after which the robot sends the next."""
SKILLS = ("dock", "beep")


@dataclass(frozen=True)
class Options:
    """The serial device and its speed, the mode that ``enable`` asks for, and limits of speed in m/s and rad/s."""

    port: str
    baud: int = 115200
    mode: str = "safe"
    max_speed: float = 0.5
    max_turn: float = 4.25


def checked(table: Mapping[str, object]) -> Options:
    """The options in ``table``; raises ``UsageError`` that names the key and what to write instead."""
    known = ("port", "baud", "mode", "max_speed", "max_turn")
    for key in table:
        if key not in known:
            raise UsageError(f'driver "create2": unknown option {key!r}; known are {", ".join(known)}')
    port = table.get("port")
    if not isinstance(port, str) or not port:
        raise _fault("port", port, 'the serial device of its cable, as in port = "/dev/ttyUSB0"')
    baud = table.get("baud", 115200)
    if type(baud) is not int or baud not in BAUDS:
        raise _fault("baud", baud, f"one of {', '.join(map(str, BAUDS))}, as in baud = 115200")
    mode = table.get("mode", "safe")
    if not isinstance(mode, str) or mode not in ("safe", "full"):
        raise _fault("mode", mode, '"safe" (it stops at cliffs by itself) or "full" (it does not)')
    speed = _number(table, "max_speed", 0.5)
    turn = _number(table, "max_turn", 4.25)
    return Options(port, baud, mode, speed, turn)


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


def _number(table: Mapping[str, object], key: str, most: float) -> float:
    value = table.get(key, most)
    if not isinstance(value, (int, float)) or isinstance(value, bool) or not 0 < value <= most:
        raise _fault(key, value, f"above 0 and at most {most:g}, as in {key} = {most:g}")
    return float(value)


def _fault(key: str, value: object, remedy: str) -> UsageError:
    return UsageError(f'driver "create2": option {key} is {value!r}, but must be {remedy}')
