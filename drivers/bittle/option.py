"""Options of the kind "bittle": read from a free table and checked, each fault with its remedy."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from drivers.bittle.codec import NAME
from drivers.bittle.gait import GAITS, Velocity
from drivers.errors import UsageError
from drivers.reading import Description

BAUDS = (57600, 115200)
BOARDS = ("auto", "biboard", "nyboard")
POSTURES = ("balance", "up", "sit", "rest", "str", "buttUp", "zero")
BEHAVIOURS = (
    *("hi", "hg", "hsk", "fiv", "chr", "ck", "clap", "cmh", "dg", "ff", "gdb", "hds", "hu", "hunt", "jmp", "kc", "mw"),
    *("nd", "pd", "pee", "pu", "pu1", "rc", "rl", "scrh", "snf", "tbl", "ts", "wh", "zz", "ang", "bf", "bx"),
)
JOINT_NAMES = {
    0: "head_pan",
    8: "lf_shoulder",
    9: "rf_shoulder",
    10: "rb_shoulder",
    11: "lb_shoulder",
    12: "lf_knee",
    13: "rf_knee",
    14: "rb_knee",
    15: "lb_knee",
}
"""The joints that a Bittle has, by the number that the firmware gives them."""
JOINT_LIMITS = {
    "head_pan": (-120, 120),
    **dict.fromkeys(("lf_shoulder", "rf_shoulder"), (-200, 80)),
    **dict.fromkeys(("rb_shoulder", "lb_shoulder"), (-80, 200)),
    **dict.fromkeys(("lf_knee", "rf_knee", "rb_knee", "lb_knee"), (-80, 200)),
}
"""Degrees."""
KNOWN = ("port", "baud", "host", "http_port", "board", "ultrasonic", "gaits")


@dataclass(frozen=True)
class Options:
    """A serial device (``port``) or an address (``host``), the board, the pins of an ultrasonic sensor, the gaits."""

    port: str = ""
    baud: int = 115200
    host: str = ""
    http_port: int = 80
    board: str = "auto"
    ultrasonic: tuple[int, int] | None = None
    gaits: tuple[tuple[str, Velocity], ...] = tuple(GAITS.items())


def checked(table: Mapping[str, object]) -> Options:
    """The options in ``table``; raises ``UsageError`` that names the key and what to write instead."""
    for key in table:
        if key not in KNOWN:
            raise UsageError(f'driver "bittle": unknown option {key!r}; known are {", ".join(KNOWN)}')
    port, host = table.get("port", ""), table.get("host", "")
    if not isinstance(port, str):
        raise _fault("port", port, 'a serial device, as in port = "/dev/ttyUSB0"')
    if not isinstance(host, str):
        raise _fault("host", host, 'the address of the robot, as in host = "192.168.1.40"')
    if bool(port) == bool(host):
        raise UsageError(
            'driver "bittle": one of the options port = "/dev/ttyUSB0" and host = "192.168.1.40" is needed'
        )
    baud = table.get("baud", 115200)
    if type(baud) is not int or baud not in BAUDS:
        raise _fault("baud", baud, f"one of {', '.join(map(str, BAUDS))}, as in baud = 115200")
    http_port = table.get("http_port", 80)
    if type(http_port) is not int or not 1 <= http_port <= 65535:
        raise _fault("http_port", http_port, "a number from 1 to 65535, as in http_port = 80")
    board = table.get("board", "auto")
    if not isinstance(board, str) or board not in BOARDS:
        raise _fault("board", board, 'one of "auto", "biboard", "nyboard"')
    if host and board == "auto":
        raise _fault("board", board, '"biboard" or "nyboard" where a host is given: they speak differently over Wi-Fi')
    return Options(port, baud, host, http_port, board, _pins(table), _gaits(table))


def described(options: Options) -> Description:
    """What a Bittle is, known without a connection."""
    speeds = [one.vx for _, one in options.gaits] + [0.0]
    turns = [one.wz for _, one in options.gaits] + [0.0]
    limits = {"base.vx": (min(speeds), max(speeds)), "base.wz": (min(turns), max(turns))}
    capabilities: dict[str, Mapping[str, float | str]] = {
        "base2d": {"quantised": "gaits"},
        "odometry": {"estimated": "from gaits"},
        "imu": {},
        "joints": {},
        "skill": {},
        "mode": {},
    }
    if options.board != "nyboard":
        capabilities["power"] = {}
    if options.ultrasonic is not None:
        capabilities["ranger"] = {"max": 2.0}
    return Description(
        kind="bittle",
        model="Petoi Bittle",
        capabilities=capabilities,
        limits={key: span for key, span in limits.items() if span[0] < span[1]},
        radius=0.11,
        rates={"state": 5.0 if options.host else 20.0},
        skills=("joint", *POSTURES, *BEHAVIOURS),
    )


def _pins(table: Mapping[str, object]) -> tuple[int, int] | None:
    pins = table.get("ultrasonic")
    if pins is None:
        return None
    if not isinstance(pins, (list, tuple)) or len(pins) != 2 or not all(type(x) is int and 0 <= x <= 50 for x in pins):
        raise _fault("ultrasonic", pins, "the pins of trigger and echo, as in ultrasonic = [16, 17]")
    return (pins[0], pins[1])


def _gaits(table: Mapping[str, object]) -> tuple[tuple[str, Velocity], ...]:
    gaits = table.get("gaits")
    if gaits is None:
        return tuple(GAITS.items())
    remedy = "skills with m/s ahead and rad/s to the left, some of which move, as in gaits = {wkF = [0.08, 0.0]}"
    if not isinstance(gaits, Mapping) or not gaits:
        raise _fault("gaits", gaits, remedy)
    found = []
    for name, pair in gaits.items():
        if not isinstance(name, str) or not NAME.fullmatch(name):
            raise _fault("gaits", gaits, remedy)
        if not isinstance(pair, (list, tuple)) or len(pair) != 2 or not all(_is_speed(one) for one in pair):
            raise _fault("gaits", gaits, remedy)
        found.append((name, Velocity(float(pair[0]), float(pair[1]))))
    if not any(one.vx for _, one in found):
        raise _fault("gaits", gaits, remedy)
    return tuple(found)


def _is_speed(value: object) -> bool:
    return type(value) in (int, float) and math.isfinite(value) and abs(value) <= 5  # type: ignore[arg-type]


def _fault(key: str, value: object, remedy: str) -> UsageError:
    return UsageError(f'driver "bittle": option {key} is {value!r}, but must be {remedy}')
