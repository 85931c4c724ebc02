"""Codec of the simulator's protocol: messages to frames and back; pure.

A frame is two marker bytes, four bytes of length (big-endian) and a msgpack array ``[tag, field, ...]``.  Invalid
messages raise ``BadFrame``; after invalid bytes the reader searches for the next marker.

Times are durations or the simulator's time stamps, never times on the sender's clock.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Annotated, Any, NotRequired, TypedDict

from msgspec import Meta, MsgspecError, Struct, convert, msgpack

from drivers.errors import BadFrame
from formats.convert import FINITE

VERSION = 2
MARKER = b"\xa9Y"
HEADER_BYTES = len(MARKER) + 4
MAX_PAYLOAD_BYTES = 256 * 1024
MAX_ENTRIES = Meta(max_length=64)
Count = Annotated[int, Meta(ge=0, le=2**63 - 1)]
Number = Annotated[float, FINITE]
Text = Annotated[str, Meta(max_length=200)]
Entry = bool | int | float | Text


class _Message(Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """A message is an array of its tag and its fields."""


class Hello(_Message, tag="hello", frozen=True):
    """From a driver: request a robot, with ``camera_fps`` pictures per second (0: none)."""

    version: Count
    robot: Text
    camera_fps: Number


class SubscribeWorld(_Message, tag="overlook", frozen=True):
    """From the operator: request the state of the world, ``rate`` times per second."""

    version: Count
    rate: Number


class Motors(_Message, tag="motors", frozen=True):
    """From a driver: switch the motors on or off."""

    on: bool


class Drive(_Message, tag="drive", frozen=True):
    """From a driver: move at these velocities (m/s, m/s, rad/s) for ``ttl`` seconds under fencing ``token``.

    ``sent`` is the simulator's time at which the command left, as estimated by the driver: the stamp of the newest
    frame plus the age of that frame. A delay on the network therefore shortens the motion; it does not end later.
    """

    vx: Number
    vy: Number
    wz: Number
    token: Count
    ttl: Number
    sent: Number


class Halt(_Message, tag="halt", frozen=True):
    """From a driver: stop now; never refused."""


class KeepAlive(_Message, tag="alive", frozen=True):
    """From drivers and the operator: keep-alive; the simulator releases the robot after some seconds without data."""


class WorldCommand(_Message, tag="order", frozen=True):
    """From the operator: ``verb`` with ``arguments``; answered by a ``CommandResult`` of the same ``number``."""

    number: Count
    verb: Text
    arguments: Annotated[tuple[Entry, ...], Meta(max_length=8)]


class Sensors(_Message, tag="sensors", frozen=True):
    """From the simulator: the robot's sensor values at its time ``t``, and the highest token that it has obeyed."""

    t: Number
    values: Annotated[Mapping[Text, Entry], MAX_ENTRIES]
    samples: Annotated[Mapping[Text, Annotated[tuple[float, ...], MAX_ENTRIES]], MAX_ENTRIES]
    token: Count


class Picture(_Message, tag="picture", frozen=True):
    """From the simulator: one camera picture as a JPEG."""

    seq: Count
    t: Number
    width: Count
    height: Count
    data: bytes


class WorldSnapshot(_Message, tag="truth", frozen=True):
    """From the simulator to the operator: the state of the whole world."""

    snapshot: Mapping[str, Any]


class CommandResult(_Message, tag="done", frozen=True):
    """From the simulator: the command was executed, or ``problem`` is the reason why not."""

    number: Count
    problem: Text


class Refused(_Message, tag="refused", frozen=True):
    """From the simulator: the robot is not available; if ``lasting``, a retry is useless."""

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
    """The fields of a snapshot that the map and the judge read without further checks; further fields may exist."""

    t: Number
    walls: tuple[Number, Number]
    dogs: tuple[_Dog, ...]
    target: NotRequired[_Target | None]
    collisions: Count


Message = (
    Hello
    | SubscribeWorld
    | Motors
    | Drive
    | Halt
    | KeepAlive
    | WorldCommand
    | Sensors
    | Picture
    | WorldSnapshot
    | CommandResult
    | Refused
)
_ENCODER = msgpack.Encoder(enc_hook=float)
"""The encoder, which converts NumPy's numbers to floats."""
_DECODER: msgpack.Decoder[Message] = msgpack.Decoder(Message)


def encode_message(message: Message) -> bytes:
    """Return the frame of ``message``."""
    payload = _ENCODER.encode(message)
    if len(payload) > MAX_PAYLOAD_BYTES:
        kind = type(message).__name__
        raise ValueError(f"a {kind} message of {len(payload)} bytes exceeds the limit of {MAX_PAYLOAD_BYTES}")
    return MARKER + len(payload).to_bytes(4, "big") + payload


def decode_message(payload: bytes) -> Message:
    """Decode the ``payload`` of one frame; raise ``BadFrame`` for any invalid bytes."""
    try:
        message = _DECODER.decode(payload)
        if isinstance(message, WorldSnapshot):
            convert(message.snapshot, _Snapshot)
    except (MsgspecError, ValueError, RecursionError) as error:
        raise BadFrame(f"{len(payload)} bytes are not a valid message: {error}") from error
    return message


class FrameReader:
    """Splits a stream into messages; counts and drops invalid data."""

    def __init__(self) -> None:
        self.frames = 0
        self.bad_frames = 0
        self._rest = bytearray()

    def read(self, data: bytes) -> Iterator[Message]:
        """Yield the messages that ``data`` completes."""
        self._rest += data
        while (payload := self._next_payload()) is not None:
            try:
                message = decode_message(payload)
            except BadFrame:
                self.bad_frames += 1
                continue
            self.frames += 1
            yield message

    def _next_payload(self) -> bytes | None:
        rest = self._rest
        while True:
            if not rest.startswith(MARKER[: len(rest)]):
                self._skip_to_marker()
            if len(rest) < HEADER_BYTES:
                return None
            length = int.from_bytes(rest[len(MARKER) : HEADER_BYTES], "big")
            if length <= MAX_PAYLOAD_BYTES:
                break
            del rest[0]
            self._skip_to_marker()
        if len(rest) < HEADER_BYTES + length:
            return None
        payload = bytes(rest[HEADER_BYTES : HEADER_BYTES + length])
        del rest[: HEADER_BYTES + length]
        return payload

    def _skip_to_marker(self) -> None:
        self.bad_frames += 1
        at = self._rest.find(MARKER)
        # The last byte may be the first half of an incomplete marker.
        keep = at if at >= 0 else len(self._rest) - (1 if self._rest.endswith(MARKER[:1]) else 0)
        del self._rest[:keep]
