"""Codec of the AIBO's ports for walk, head, joints, emergency stop, world state and gains; pure.

All numbers are little-endian, 32 bits wide.  The world state has two dialects, distinguished by their first bytes.
``T4`` (Tekkotsu 4.0 and 5.x) contains the model of the robot and the number of values of each kind; ``T2`` (Tekkotsu
2.x) contains neither the model nor a frame number. The reader takes the numbers of sensors from the stream, so it also
accepts models other than the ERS-7.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from drivers.errors import BadFrame

T4, T2 = "T4", "T2"
MAX_LINE_BYTES = 4096
MAX_COUNT = 256
MAX_MODEL_BYTES = 32
MODEL_START = b"ERS-"
PID_JOINTS = 18
COMMAND_BYTES = 5
"""Bytes of each walk and head command: a letter and a float."""


@dataclass(frozen=True)
class WorldState:
    """The sensor data at ``t`` ms after the dog was switched on (wraps after 49.7 days)."""

    dialect: str
    model: str
    t: int
    frame: int
    outputs: tuple[float, ...]
    sensors: tuple[float, ...]
    buttons: tuple[float, ...]
    duties: tuple[float, ...]


def encode_command(letter: str, value: float) -> bytes:
    """Return a walk command (``f s r`` and the digits) or a head command (``t p r``) with a value from -1 to 1."""
    return struct.pack("<cf", letter.encode("ascii"), value)


class IncompletePacket(Exception):
    """A packet is incomplete: the whole packet has at least ``need`` bytes."""

    def __init__(self, need: int) -> None:
        super().__init__(need)
        self.need = need


def encode_string(text: str) -> bytes:
    """Encode a string as the dog does: its length, its bytes and a NUL."""
    data = text.encode("latin-1")
    return struct.pack("<I", len(data)) + data + b"\0"


class Cursor:
    """Reads fields from ``data`` in order; raises ``IncompletePacket`` at its end, ``BadFrame`` for invalid values."""

    def __init__(self, data: bytes) -> None:
        self.at = 0
        self._data = data

    def read(self, size: int) -> bytes:
        """Read ``size`` bytes."""
        piece = self._data[self.at : self.at + size]
        if len(piece) < size:
            raise IncompletePacket(self.at + size)
        self.at += size
        return piece

    def read_words(self, count: int) -> tuple[int, ...]:
        """Read ``count`` unsigned numbers."""
        return struct.unpack(f"<{count}I", self.read(4 * count))

    def read_floats(self, count: int) -> tuple[float, ...]:
        """Read ``count`` floats."""
        return struct.unpack(f"<{count}f", self.read(4 * count))

    def read_count(self) -> int:
        """Read the number of values that follow."""
        (count,) = self.read_words(1)
        if count > MAX_COUNT:
            raise BadFrame(f"a count of {count} values exceeds the maximum of {MAX_COUNT}")
        return count

    def read_row(self) -> tuple[float, ...]:
        """Read a count and that many floats."""
        return self.read_floats(self.read_count())

    def read_name(self) -> str:
        """Read a short name that ends with a NUL."""
        end = self._data.find(b"\0", self.at, self.at + MAX_MODEL_BYTES)
        if end < 0:
            if len(self._data) - self.at >= MAX_MODEL_BYTES:
                raise BadFrame("name without terminating NUL")
            raise IncompletePacket(len(self._data) + 1)
        text = self._data[self.at : end]
        self.at = end + 1
        return text.decode("latin-1")

    def read_string(self, limit: int) -> str:
        """Read a string of at most ``limit`` bytes, in the encoding of ``string``."""
        (length,) = self.read_words(1)
        if length > limit:
            raise BadFrame(f"string of {length} bytes exceeds the maximum of {limit}")
        data = self.read(length + 1)
        if data[-1]:
            raise BadFrame("string without terminating NUL")
        return data[:-1].decode("latin-1")


class CommandReader:
    """Splits the stream to the walk or head port into commands, as the dog does."""

    def __init__(self) -> None:
        self._rest = bytearray()

    def read(self, data: bytes) -> Iterator[tuple[str, float]]:
        """Yield letter and value of each command that ``data`` completes."""
        self._rest += data
        while len(self._rest) >= COMMAND_BYTES:
            letter, value = struct.unpack("<cf", self._rest[:COMMAND_BYTES])
            del self._rest[:COMMAND_BYTES]
            yield letter.decode("latin-1"), value


class LineReader:
    """Splits a stream into lines; overlong lines are discarded and counted."""

    def __init__(self) -> None:
        self.bad_lines = 0
        self._rest = b""

    def read(self, data: bytes) -> Iterator[str]:
        """Yield the lines that ``data`` completes, without their line ends."""
        *lines, self._rest = (self._rest + data).split(b"\n")
        if len(self._rest) > MAX_LINE_BYTES:
            self._rest = b""
            self.bad_lines += 1
        for line in lines:
            if len(line) > MAX_LINE_BYTES:
                self.bad_lines += 1
                continue
            yield line.removesuffix(b"\r").decode("latin-1")


def encode_state(state: WorldState) -> bytes:
    """Encode ``state`` in its dialect; of the outputs, T2 contains only the joints, which come first."""
    if state.dialect == T2:
        rows = (state.outputs[: len(state.duties)], state.sensors, state.buttons)
        return struct.pack("<I", state.t) + b"".join(_encode_row(row) for row in rows) + _encode_floats(state.duties)
    head = state.model.encode("ascii") + b"\0" + struct.pack("<II", state.t, state.frame)
    return head + b"".join(_encode_row(row) for row in (state.outputs, state.sensors, state.buttons, state.duties))


def encode_gains(t: int, pids: Sequence[tuple[float, float, float]]) -> bytes:
    """Encode the packet of port 10032: the gains P, I and D of each joint at ``t`` ms."""
    return struct.pack("<II", t, len(pids)) + _encode_floats([value for row in pids for value in row])


def _encode_floats(row: Sequence[float]) -> bytes:
    return struct.pack(f"<{len(row)}f", *row)


def _encode_row(row: Sequence[float]) -> bytes:
    return struct.pack("<I", len(row)) + _encode_floats(row)


class StateReader:
    """Splits a stream into world states of either dialect; raises ``BadFrame`` for other data.

    Packets have no start marker, so after ``BadFrame`` the link has to be reopened with a new reader.
    """

    def __init__(self) -> None:
        self._rest = bytearray()
        self._need = 8

    def read(self, data: bytes) -> Iterator[WorldState]:
        """Yield the world states that ``data`` completes."""
        self._rest += data
        while len(self._rest) >= self._need:
            cursor = Cursor(bytes(self._rest))
            try:
                state = _read_state(cursor, self._rest.startswith(MODEL_START))
            except IncompletePacket as short:
                self._need = short.need
                continue
            del self._rest[: cursor.at]
            self._need = 8
            yield state


def _read_state(cursor: Cursor, has_model: bool) -> WorldState:
    if has_model:
        model = cursor.read_name()
        t, frame = cursor.read_words(2)
        return WorldState(
            T4, model, t, frame, cursor.read_row(), cursor.read_row(), cursor.read_row(), cursor.read_row()
        )
    (t,) = cursor.read_words(1)
    joints = cursor.read_count()
    if joints != PID_JOINTS:
        raise BadFrame(f"the data is in neither dialect: no model, and {joints} joints")
    return WorldState(
        T2, "", t, 0, cursor.read_floats(joints), cursor.read_row(), cursor.read_row(), cursor.read_floats(joints)
    )
