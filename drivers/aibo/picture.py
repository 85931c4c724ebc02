"""Packets of the raw camera (port 10011), in both directions; pure.

A packet is a header and one or three blocks, each with one channel or a JPEG. A JPEG is passed on unchanged; raw
channels are converted to ``yuv444`` (three planes of the same size) or ``mono8``.  Over UDP each datagram is one
packet.  Over TCP packets have no delimiter, but every header begins with the same 18 bytes, by which the reader
resynchronizes after invalid data.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from drivers.aibo.codec import Cursor, IncompletePacket, encode_string
from drivers.errors import BadFrame
from formats.jpeg import read_size

REQUEST = b"connection request"
COLOUR, SINGLE = 0, 1
MAX_SIDE_PX = 1024
MAX_JPEG_BYTES = 512 * 1024
MAX_TEXT_BYTES = 64 * 1024
BLANK_VALUE = 0x80


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
    """Text about the joints, which a different client of the camera requested."""

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
HEADER_START = encode_string("TekkotsuImage")
CLOSING = encode_string("CloseConnection")
POSTURE = b"#POS"


def encode_header(encoding: int, compression: int, width: int, height: int, t: int, number: int) -> bytes:
    """Encode the header of a packet."""
    return HEADER_START + struct.pack("<6I", encoding, compression, width, height, t, number)


def encode_block(one: Block, size: int | None = None) -> bytes:
    """Encode one block; ``size`` replaces the length of its JPEG, so that tests can create invalid packets."""
    head = (
        encode_string("FbkImage")
        + struct.pack("<4I", one.width, one.height, one.layer, one.channel)
        + encode_string(one.form)
    )
    if one.form.startswith("JPEG"):
        head += struct.pack("<I", len(one.data) if size is None else size)
    return head + one.data


def decode_message(data: bytes) -> Message:
    """Decode the message in one datagram; raise ``BadFrame`` if it is invalid."""
    cursor = Cursor(data)
    try:
        message = _read_message(cursor)
    except IncompletePacket as short:
        raise BadFrame(f"packet is cut off: {len(data)} of at least {short.need} bytes") from short
    if cursor.at != len(data):
        raise BadFrame(f"{len(data) - cursor.at} extra bytes after the packet")
    return message


class PictureReader:
    """Splits a stream into messages; counts invalid data and continues at the next header."""

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
                message = _read_message(cursor)
            except IncompletePacket as short:
                self._need = short.need
                continue
            except BadFrame:
                self.bad_frames += 1
                self._skip_to_header()
                continue
            del self._rest[: cursor.at]
            self._need = 8
            yield message

    def _skip_to_header(self) -> None:
        at = self._rest.find(HEADER_START, 1)
        # The last bytes may be the start of a header that is not complete yet.
        del self._rest[: at if at > 0 else max(1, len(self._rest) - len(HEADER_START) + 1)]
        self._need = 8 if at > 0 else len(HEADER_START)


def _check_start(data: bytearray) -> None:
    """Reject invalid data early: if read as a length, its first bytes could make the reader wait for a long time."""
    for start in (HEADER_START, CLOSING):
        if start.startswith(data[: len(start)]):
            return
    if not POSTURE.startswith(data[4 : 4 + len(POSTURE)]):
        raise BadFrame("the data is not the start of a camera packet")


def _read_message(cursor: Cursor) -> Message:
    kind = cursor.read_string(MAX_TEXT_BYTES)
    if kind == "CloseConnection":
        return Closing()
    if kind.startswith("#POS"):
        return Posture(kind)
    if kind != "TekkotsuImage":
        raise BadFrame(f"unknown camera packet {kind!r}")
    encoding, _, width, height, t, number = cursor.read_words(6)
    if encoding not in (COLOUR, SINGLE) or not (0 < width <= MAX_SIDE_PX and 0 < height <= MAX_SIDE_PX):
        raise BadFrame(f"unsupported picture: {width} x {height} pixels, encoding {encoding}")
    first = _read_block(cursor)
    is_whole = first.form == "JPEGColor" or encoding == SINGLE
    blocks = [first] if is_whole else [first, _read_block(cursor), _read_block(cursor)]
    return Picture(width, height, t, number, *_join_blocks(blocks, width, height))


def _read_block(cursor: Cursor) -> Block:
    if cursor.read_string(32) != "FbkImage":
        raise BadFrame("the data is not the start of a block of channels")
    width, height, layer, channel = cursor.read_words(4)
    form = cursor.read_string(32)
    if form in ("JPEGColor", "JPEGGrayscale"):
        (size,) = cursor.read_words(1)
        if size > MAX_JPEG_BYTES:
            raise BadFrame(f"JPEG of {size} bytes exceeds the maximum of {MAX_JPEG_BYTES}")
        data = cursor.read(size)
        if read_size(data) is None:
            raise BadFrame("JPEG is cut off, or too large to decode")
    elif form == "RawImage":
        if not (0 < width <= MAX_SIDE_PX and 0 < height <= MAX_SIDE_PX):
            raise BadFrame(f"unsupported channel size: {width} x {height} pixels")
        data = cursor.read(width * height)
    elif form == "blank":
        data = b""
    else:
        raise BadFrame(f"unsupported block format {form!r}")
    return Block(width, height, form, data, channel, layer)


def _join_blocks(blocks: Sequence[Block], width: int, height: int) -> tuple[str, bytes]:
    """Return encoding and bytes; of three JPEGs, one per channel, return the brightness, a valid picture by itself."""
    if blocks[0].form.startswith("JPEG"):
        return "jpeg", blocks[0].data
    if any(one.form.startswith("JPEG") for one in blocks):
        raise BadFrame("the picture contains both raw channels and JPEGs")
    planes = [_scale_up(one, width, height) for one in blocks]
    return ("yuv444" if len(planes) == 3 else "mono8"), b"".join(planes)


def _scale_up(one: Block, width: int, height: int) -> bytes:
    """Scale a channel to full size by repeating pixels."""
    if one.form == "blank":
        return bytes([BLANK_VALUE]) * (width * height)
    if (one.width, one.height) == (width, height):
        return one.data
    columns = [x * one.width // width for x in range(width)]
    rows = []
    for y in range(height):
        start = y * one.height // height * one.width
        line = one.data[start : start + one.width]
        rows.append(bytes(map(line.__getitem__, columns)))
    return b"".join(rows)
