"""Codec of the yard's wire: messages to frames and back; pure.

A frame is two marker bytes, four bytes of length (big-endian) and a msgpack array ``[tag, field, ...]``.  What is no
message raises ``BadFrame``; after bytes that are no frame the reader looks for the next marker.

Durations and the yard's own stamps travel, never a moment of the sender's clock.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Annotated, Any, NotRequired, TypedDict

from msgspec import Meta, MsgspecError, Struct, convert, msgpack

from drivers.errors import BadFrame
from formats.convert import FINITE

VERSION = 2
MARKER = b"\xa9Y"
HEADER = len(MARKER) + 4
MAX_PAYLOAD = 256 * 1024
MAX_ENTRIES = Meta(max_length=64)
Count = Annotated[int, Meta(ge=0, le=2**63 - 1)]
Number = Annotated[float, FINITE]
Text = Annotated[str, Meta(max_length=200)]
Entry = bool | int | float | Text


class _Message(Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """A message is an array of its tag and its fields."""


class Hello(_Message, tag="hello", frozen=True):
    """From a driver: give me the robot, with so many pictures a second (0: none)."""

    version: Count
    robot: Text
    camera_fps: Number


class Overlook(_Message, tag="overlook", frozen=True):
    """From the operator: send the truth about the yard, so many times a second."""

    version: Count
    rate: Number


class Motors(_Message, tag="motors", frozen=True):
    """From a driver: motors on or off."""

    on: bool


class Drive(_Message, tag="drive", frozen=True):
    """From a driver: walk like this (m/s, m/s, rad/s) for ``ttl`` seconds under fencing ``token``.

    ``sent`` is the yard's own time as the driver knew it when the command left: the stamp of the newest frame it had
    seen, plus the time it had waited since.  A command that was held up on the way is thereby shortened, not moved.
    """

    vx: Number
    vy: Number
    wz: Number
    token: Count
    ttl: Number
    sent: Number


class Halt(_Message, tag="halt", frozen=True):
    """From a driver: stand still now; never refused."""


class Alive(_Message, tag="alive", frozen=True):
    """From either client: still here; a yard that hears nothing for some seconds gives the robot free."""


class Order(_Message, tag="order", frozen=True):
    """From the operator: ``verb`` with ``arguments``; answered by a ``Done`` of the same ``number``."""

    number: Count
    verb: Text
    arguments: Annotated[tuple[Entry, ...], Meta(max_length=8)]


class Sensors(_Message, tag="sensors", frozen=True):
    """From the yard: what the robot feels at ``t`` of the yard's time, and the highest token that it has obeyed."""

    t: Number
    values: Annotated[Mapping[Text, Entry], MAX_ENTRIES]
    samples: Annotated[Mapping[Text, Annotated[tuple[float, ...], MAX_ENTRIES]], MAX_ENTRIES]
    token: Count


class Picture(_Message, tag="picture", frozen=True):
    """From the yard: one camera picture as a JPEG."""

    seq: Count
    t: Number
    width: Count
    height: Count
    data: bytes


class Truth(_Message, tag="truth", frozen=True):
    """From the yard to the operator: the whole yard as seen from above."""

    snapshot: Mapping[str, Any]


class Done(_Message, tag="done", frozen=True):
    """From the yard: the order of this number was carried out, or, where ``problem`` is not empty, why not."""

    number: Count
    problem: Text


class Refused(_Message, tag="refused", frozen=True):
    """From the yard: no robot for you; ``lasting`` says that asking again will not help."""

    reason: Text
    lasting: bool


class _Dog(TypedDict):
    name: Text
    x: Number
    y: Number
    heading: Number
    stripes: Number
    moving: bool


class _Target(TypedDict):
    x: Number
    y: Number
    radius: Number


class _Snapshot(TypedDict):
    """What the map and the referee read of a snapshot without looking twice; it may have more."""

    t: Number
    walls: tuple[Number, Number]
    dogs: tuple[_Dog, ...]
    target: NotRequired[_Target | None]
    collisions: Count


Message = Hello | Overlook | Motors | Drive | Halt | Alive | Order | Sensors | Picture | Truth | Done | Refused
_ENCODER = msgpack.Encoder(enc_hook=float)
"""NumPy's numbers are sent as what they are."""
_DECODER: msgpack.Decoder[Message] = msgpack.Decoder(Message)


def encoded(message: Message) -> bytes:
    """The frame of ``message``."""
    payload = _ENCODER.encode(message)
    if len(payload) > MAX_PAYLOAD:
        kind = type(message).__name__
        raise ValueError(f"a {kind} message of {len(payload)} bytes is above the limit of {MAX_PAYLOAD}")
    return MARKER + len(payload).to_bytes(4, "big") + payload


def decoded(payload: bytes) -> Message:
    """The message in the ``payload`` of one frame; raises ``BadFrame`` for anything else, whatever the bytes are."""
    try:
        message = _DECODER.decode(payload)
        if isinstance(message, Truth):
            convert(message.snapshot, _Snapshot)
    except (MsgspecError, ValueError, RecursionError) as error:
        raise BadFrame(f"{len(payload)} bytes are no message: {error}") from error
    return message


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
