"""Picture: the packets of the raw camera (port 10011), both ways; pure.

A packet is a header and one block of channels, or three; a JPEG passes through as it is, bare channels become
``yuv444`` (three planes of the same size) or ``mono8``.  Over UDP each datagram is one packet; over TCP nothing marks
the next, but every header begins with the same 18 bytes, by which the reader finds its way after bytes that are none.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from drivers.aibo.codec import Cursor, Short, string
from drivers.errors import BadFrame
from formats.jpeg import size_of

REQUEST = b"connection request"
COLOUR, SINGLE = 0, 1
MAX_SIDE = 1024
MAX_JPEG = 512 * 1024
MAX_TEXT = 64 * 1024
BLANK = 0x80


@dataclass(frozen=True)
class Picture:
    """One picture, taken ``t`` ms after the dog was switched on; ``encoding`` is ``jpeg``, ``yuv444`` or ``mono8``."""

    width: int
    height: int
    t: int
    number: int
    encoding: str
    data: bytes


@dataclass(frozen=True)
class Closing:
    """The camera server is stopping."""


@dataclass(frozen=True)
class Posture:
    """Text about the joints that another client of the camera asked for."""

    text: str


@dataclass(frozen=True)
class Block:
    """One channel, or a whole colour JPEG."""

    width: int
    height: int
    form: str
    data: bytes
    channel: int = 0
    layer: int = 3


Message = Picture | Closing | Posture
START = string("TekkotsuImage")
CLOSING = string("CloseConnection")
POSTURE = b"#POS"


def header(encoding: int, compression: int, width: int, height: int, t: int, number: int) -> bytes:
    """The header of a packet."""
    return START + struct.pack("<6I", encoding, compression, width, height, t, number)


def block(one: Block, size: int | None = None) -> bytes:
    """The bytes of one block; ``size`` is what it says of the length of its JPEG, where that is not the truth."""
    head = string("FbkImage") + struct.pack("<4I", one.width, one.height, one.layer, one.channel) + string(one.form)
    if one.form.startswith("JPEG"):
        head += struct.pack("<I", len(one.data) if size is None else size)
    return head + one.data


def decoded(data: bytes) -> Message:
    """The message in one datagram; raises ``BadFrame`` for anything else."""
    cursor = Cursor(data)
    try:
        message = _message(cursor)
    except Short as short:
        raise BadFrame(f"{len(data)} bytes are less than a packet of {short.need}") from short
    if cursor.at != len(data):
        raise BadFrame(f"{len(data) - cursor.at} bytes are left after the packet")
    return message


class PictureReader:
    """Cuts a stream into messages, however it is cut; counts what is none, and goes on at the next header."""

    def __init__(self) -> None:
        self.bad_frames = 0
        self._rest = bytearray()
        self._need = 8

    def read(self, data: bytes) -> Iterator[Message]:
        """Yield the messages that ``data`` completes."""
        self._rest += data
        while len(self._rest) >= self._need:
            cursor = Cursor(bytes(self._rest))
            try:
                _check_start(self._rest)
                message = _message(cursor)
            except Short as short:
                self._need = short.need
                continue
            except BadFrame:
                self.bad_frames += 1
                self._skip()
                continue
            del self._rest[: cursor.at]
            self._need = 8
            yield message

    def _skip(self) -> None:
        at = self._rest.find(START, 1)
        # The last bytes may be the beginning of a header whose rest is still on the way.
        del self._rest[: at if at > 0 else max(1, len(self._rest) - len(START) + 1)]
        self._need = 8 if at > 0 else len(START)


def _check_start(data: bytearray) -> None:
    """Refuse at once what begins no packet: its first bytes, read as a length, could have one wait for long."""
    for start in (START, CLOSING):
        if start.startswith(data[: len(start)]):
            return
    if not POSTURE.startswith(data[4 : 4 + len(POSTURE)]):
        raise BadFrame("no packet of the camera begins so")


def _message(cursor: Cursor) -> Message:
    kind = cursor.string(MAX_TEXT)
    if kind == "CloseConnection":
        return Closing()
    if kind.startswith("#POS"):
        return Posture(kind)
    if kind != "TekkotsuImage":
        raise BadFrame("no packet of the camera begins so")
    encoding, _, width, height, t, number = cursor.words(6)
    if encoding not in (COLOUR, SINGLE) or not (0 < width <= MAX_SIDE and 0 < height <= MAX_SIDE):
        raise BadFrame(f"a picture of {width} x {height} pixels in encoding {encoding}")
    first = _block(cursor)
    is_whole = first.form == "JPEGColor" or encoding == SINGLE
    blocks = [first] if is_whole else [first, _block(cursor), _block(cursor)]
    return Picture(width, height, t, number, *_put_together(blocks, width, height))


def _block(cursor: Cursor) -> Block:
    if cursor.string(32) != "FbkImage":
        raise BadFrame("no block of channels begins so")
    width, height, layer, channel = cursor.words(4)
    form = cursor.string(32)
    if form in ("JPEGColor", "JPEGGrayscale"):
        (size,) = cursor.words(1)
        if size > MAX_JPEG:
            raise BadFrame(f"a JPEG of {size} bytes")
        data = cursor.take(size)
        if size_of(data) is None:
            raise BadFrame("a JPEG that is cut off, or too large to be decoded")
    elif form == "RawImage":
        if not (0 < width <= MAX_SIDE and 0 < height <= MAX_SIDE):
            raise BadFrame(f"a channel of {width} x {height} pixels")
        data = cursor.take(width * height)
    elif form == "blank":
        data = b""
    else:
        raise BadFrame(f"a block in the format {form!r}")
    return Block(width, height, form, data, channel, layer)


def _put_together(blocks: Sequence[Block], width: int, height: int) -> tuple[str, bytes]:
    """Encoding and bytes; of three JPEGs, one a channel, the brightness alone, which is a picture by itself."""
    if blocks[0].form.startswith("JPEG"):
        return "jpeg", blocks[0].data
    if any(one.form.startswith("JPEG") for one in blocks):
        raise BadFrame("bare channels and JPEGs in one picture")
    planes = [_grown(one, width, height) for one in blocks]
    return ("yuv444" if len(planes) == 3 else "mono8"), b"".join(planes)


def _grown(one: Block, width: int, height: int) -> bytes:
    """The channel at full size: each pixel again as often as the full picture has more."""
    if one.form == "blank":
        return bytes([BLANK]) * (width * height)
    if (one.width, one.height) == (width, height):
        return one.data
    columns = [x * one.width // width for x in range(width)]
    rows = []
    for y in range(height):
        start = y * one.height // height * one.width
        line = one.data[start : start + one.width]
        rows.append(bytes(map(line.__getitem__, columns)))
    return b"".join(rows)
