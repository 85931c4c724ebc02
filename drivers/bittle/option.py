"""Options of the kind "bittle"; each error says how to correct it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Literal

from msgspec import Meta

from drivers.bittle.codec import NAME
from drivers.bittle.gait import GAITS, Velocity
from drivers.errors import UsageError
from drivers.option import Port, convert_options, make_option_error
from drivers.reading import Description
from formats.convert import ConversionStep

Baud = Literal[57600, 115200]
Board = Literal["auto", "biboard", "nyboard"]
Pin = Annotated[int, Meta(ge=0, le=50)]
Speed = Annotated[float, Meta(ge=-5, le=5)]
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
"""The joints of a Bittle, by their number in the firmware."""
JOINT_LIMITS = {
    "head_pan": (-120, 120),
    **dict.fromkeys(("lf_shoulder", "rf_shoulder"), (-200, 80)),
    **dict.fromkeys(("rb_shoulder", "lb_shoulder"), (-80, 200)),
    **dict.fromkeys(("lf_knee", "rf_knee", "rb_knee", "lb_knee"), (-80, 200)),
}
"""The lowest and highest angle of each joint in degrees."""


def _parse_gaits(table: Mapping[str, tuple[float, float]]) -> tuple[tuple[str, Velocity], ...]:
    if not all(NAME.fullmatch(name) for name in table) or not any(vx for vx, _ in table.values()):
        raise ValueError
    return tuple((name, Velocity(*pair)) for name, pair in table.items())


_GAITS_DESCRIPTION = "skills with m/s ahead and rad/s to the left, some of which move, such as {wkF = [0.08, 0.0]}"


@dataclass(frozen=True)
class Options:
    """A serial device (``port``) or an address (``host``), the board, the pins of an ultrasonic sensor, the gaits."""

    port: str = ""
    baud: Baud = 115200
    host: str = ""
    http_port: Port = 80
    board: Board = "auto"
    ultrasonic: Annotated[
        tuple[Pin, Pin] | None,
        Meta(description="the pins of trigger and echo, from 0 to 50", examples=[[16, 17]]),
    ] = None
    gaits: Annotated[
        tuple[tuple[str, Velocity], ...],
        Meta(description=_GAITS_DESCRIPTION),
        ConversionStep(_parse_gaits, raw=dict[str, tuple[Speed, Speed]]),
    ] = tuple(GAITS.items())


def parse_options(table: Mapping[str, object]) -> Options:
    """Convert and check ``table``; raise ``UsageError`` with the key, the problem and the remedy."""
    options = convert_options("bittle", table, Options)
    if bool(options.port) == bool(options.host):
        raise UsageError('driver "bittle": write one of the options port = "/dev/ttyUSB0" and host = "192.168.1.40"')
    if options.host and options.board == "auto":
        raise make_option_error(
            "bittle", "board", "is auto, which is not possible with host", 'write "biboard" or "nyboard"'
        )
    return options


def make_description(options: Options) -> Description:
    """Return the description of a Bittle."""
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
