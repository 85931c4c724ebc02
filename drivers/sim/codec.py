"""Codec of the yard's wire: messages to frames and back; pure.

A frame is two marker bytes, four bytes of length (big-endian) and a msgpack array ``[tag, field, ...]``.  What is no
message raises ``BadFrame``; after bytes that are no frame the reader looks for the next marker.

Durations and the yard's own stamps travel, never a moment of the sender's clock.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, fields

import msgpack

from drivers.errors import BadFrame
from drivers.reading import Value

VERSION = 2
MARKER = b"\xa9Y"
HEADER = len(MARKER) + 4
MAX_PAYLOAD = 256 * 1024
MAX_ENTRIES = 64
MAX_TEXT = 200


@dataclass(frozen=True)
class Hello:
    """From a driver: give me the robot, with so many pictures a second (0: none)."""

    version: int
    robot: str
    camera_fps: float


@dataclass(frozen=True)
class Overlook:
    """From the operator: send the truth about the yard, so many times a second."""

    version: int
    rate: float


@dataclass(frozen=True)
class Motors:
    """From a driver: motors on or off."""

    on: bool


@dataclass(frozen=True)
class Drive:
    """From a driver: walk like this (m/s, m/s, rad/s) for ``ttl`` seconds under fencing ``token``.

    ``sent`` is the yard's own time as the driver knew it when the command left: the stamp of the newest frame it had
    seen, plus the time it had waited since.  A command that was held up on the way is thereby shortened, not moved.
    """

    vx: float
    vy: float
    wz: float
    token: int
    ttl: float
    sent: float


@dataclass(frozen=True)
class Halt:
    """From a driver: stand still now; never refused."""


@dataclass(frozen=True)
class Alive:
    """From either client: still here; a yard that hears nothing for some seconds gives the robot free."""


@dataclass(frozen=True)
class Order:
    """From the operator: ``verb`` with ``arguments``; answered by a ``Done`` of the same ``number``."""

    number: int
    verb: str
    arguments: tuple[Value, ...]


@dataclass(frozen=True)
class Sensors:
    """From the yard: what the robot feels at ``t`` of the yard's time, and the highest token that it has obeyed."""

    t: float
    values: Mapping[str, Value]
    samples: Mapping[str, tuple[float, ...]]
    token: int = 0


@dataclass(frozen=True)
class Picture:
    """From the yard: one camera picture as a JPEG."""

    seq: int
    t: float
    width: int
    height: int
    data: bytes = field(repr=False)


@dataclass(frozen=True)
class Truth:
    """From the yard to the operator: the whole yard as seen from above."""

    snapshot: Mapping[str, object]


@dataclass(frozen=True)
class Done:
    """From the yard: the order of this number was carried out, or, where ``problem`` is not empty, why not."""

    number: int
    problem: str


@dataclass(frozen=True)
class Refused:
    """From the yard: no robot for you; ``lasting`` says that asking again will not help."""

    reason: str
    lasting: bool


Message = Hello | Overlook | Motors | Drive | Halt | Alive | Order | Sensors | Picture | Truth | Done | Refused
Check = Callable[[object], bool]


def _is_count(value: object) -> bool:
    return type(value) is int and 0 <= value < 2**63


def _is_number(value: object) -> bool:
    return type(value) in (int, float) and math.isfinite(value)  # type: ignore[arg-type]


def _is_flag(value: object) -> bool:
    return type(value) is bool


def _is_text(value: object) -> bool:
    return isinstance(value, str) and len(value) <= MAX_TEXT


def _is_bytes(value: object) -> bool:
    return isinstance(value, bytes)


def _is_value(value: object) -> bool:
    return type(value) in (bool, int, float) or _is_text(value)


def _is_values(value: object) -> bool:
    if not isinstance(value, dict) or len(value) > MAX_ENTRIES:
        return False
    return all(_is_text(key) and _is_value(entry) for key, entry in value.items())


def _is_samples(value: object) -> bool:
    if not isinstance(value, dict) or len(value) > MAX_ENTRIES:
        return False
    return all(
        _is_text(key) and isinstance(row, tuple) and len(row) <= MAX_ENTRIES and all(type(x) is float for x in row)
        for key, row in value.items()
    )


def _is_arguments(value: object) -> bool:
    return isinstance(value, tuple) and len(value) <= 8 and all(_is_value(entry) for entry in value)


def _is_snapshot(value: object) -> bool:
    """Whether the map and the referee can read it without looking twice."""
    if not isinstance(value, dict) or not _is_number(value.get("t")) or not _is_count(value.get("collisions")):
        return False
    walls, dogs, target = value.get("walls"), value.get("dogs"), value.get("target")
    if not isinstance(walls, tuple) or len(walls) != 2 or not all(_is_number(side) for side in walls):
        return False
    if target is not None and not _has_numbers(target, "x", "y", "radius"):
        return False
    return isinstance(dogs, tuple) and all(
        _has_numbers(dog, "x", "y", "heading", "stripes") and _is_text(dog.get("name")) and _is_flag(dog.get("moving"))
        for dog in dogs
    )


def _has_numbers(value: object, *keys: str) -> bool:
    return isinstance(value, dict) and all(_is_number(value.get(key)) for key in keys)


_TABLE: dict[str, tuple[type[Message], tuple[Check, ...]]] = {
    "hello": (Hello, (_is_count, _is_text, _is_number)),
    "overlook": (Overlook, (_is_count, _is_number)),
    "motors": (Motors, (_is_flag,)),
    "drive": (Drive, (_is_number, _is_number, _is_number, _is_count, _is_number, _is_number)),
    "halt": (Halt, ()),
    "alive": (Alive, ()),
    "order": (Order, (_is_count, _is_text, _is_arguments)),
    "sensors": (Sensors, (_is_number, _is_values, _is_samples, _is_count)),
    "picture": (Picture, (_is_count, _is_number, _is_count, _is_count, _is_bytes)),
    "truth": (Truth, (_is_snapshot,)),
    "done": (Done, (_is_count, _is_text)),
    "refused": (Refused, (_is_text, _is_flag)),
}
_TAGS: dict[type[Message], tuple[str, tuple[str, ...]]] = {
    kind: (tag, tuple(item.name for item in fields(kind))) for tag, (kind, _) in _TABLE.items()
}


def encoded(message: Message) -> bytes:
    """The frame of ``message``."""
    tag, names = _TAGS[type(message)]
    payload = msgpack.packb([tag, *(getattr(message, name) for name in names)])
    if len(payload) > MAX_PAYLOAD:
        raise ValueError(f"a {tag} message of {len(payload)} bytes is above the limit of {MAX_PAYLOAD}")
    return MARKER + len(payload).to_bytes(4, "big") + bytes(payload)


def decoded(payload: bytes) -> Message:
    """The message in the ``payload`` of one frame; raises ``BadFrame`` for anything else, whatever the bytes are."""
    try:
        row = msgpack.unpackb(payload, use_list=False, max_str_len=4096, max_map_len=1024, max_array_len=1024)
    except (ValueError, TypeError, RecursionError, msgpack.UnpackException) as error:
        raise BadFrame(f"{len(payload)} bytes are no msgpack: {error}") from error
    if not isinstance(row, tuple) or not row or not isinstance(row[0], str) or row[0] not in _TABLE:
        raise BadFrame("the payload is no known message")
    kind, checks = _TABLE[row[0]]
    if len(row) != 1 + len(checks) or not all(check(value) for check, value in zip(checks, row[1:], strict=True)):
        raise BadFrame(f"a {row[0]} message has wrong fields")
    return kind(*row[1:])


class FrameReader:
    """Cuts a stream of bytes into messages, however the bytes are cut; counts and drops what is none."""

    def __init__(self) -> None:
        self.frames = 0
        self.bad_frames = 0
        self._rest = bytearray()

    def read(self, data: bytes) -> Iterator[Message]:
        """Yield the messages that ``data`` completes."""
        self._rest += data
        while (payload := self._next_payload()) is not None:
            try:
                message = decoded(payload)
            except BadFrame:
                self.bad_frames += 1
                continue
            self.frames += 1
            yield message

    def _next_payload(self) -> bytes | None:
        rest = self._rest
        while True:
            if not rest.startswith(MARKER[: len(rest)]):
                self._drop_to_marker()
            if len(rest) < HEADER:
                return None
            length = int.from_bytes(rest[len(MARKER) : HEADER], "big")
            if length <= MAX_PAYLOAD:
                break
            del rest[0]
            self._drop_to_marker()
        if len(rest) < HEADER + length:
            return None
        payload = bytes(rest[HEADER : HEADER + length])
        del rest[: HEADER + length]
        return payload

    def _drop_to_marker(self) -> None:
        self.bad_frames += 1
        at = self._rest.find(MARKER)
        # The last byte may be the first half of a marker whose other half is still on the way.
        keep = at if at >= 0 else len(self._rest) - (1 if self._rest.endswith(MARKER[:1]) else 0)
        del self._rest[:keep]
