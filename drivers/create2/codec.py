"""Codec of iRobot's Open Interface: commands to the robot and sensor packets from it; pure.

Numbers of two bytes are big-endian.  Both sides are implemented: ``stream_frame`` and ``CommandReader`` are for
emulators of the robot.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

RESET, START, SAFE, FULL, CLEAN, DRIVE, LEDS, SONG, PLAY, DOCK, DIRECT = (
    7,
    128,
    131,
    132,
    135,
    137,
    139,
    140,
    141,
    143,
    145,
)
SENSORS, STREAM, QUERY, PAUSE, STOP = 142, 148, 149, 150, 173
MODES = ("off", "passive", "safe", "full")
FRAME_S = 0.015
"""Interval in seconds at which the robot refreshes and streams its packets."""
TOP_SPEED = 500
"""Top speed of a wheel in mm/s."""
STRAIGHT = -0x8000
HEAD = 19
MAX_FRAME = 172
"""Largest frame in bytes that a line of 115200 baud carries in ``FRAME_S``."""


@dataclass(frozen=True)
class Packet:
    """One sensor packet: its name, its ``struct`` format, and its range of valid values."""

    name: str
    form: str
    low: int
    high: int

    @property
    def size(self) -> int:
        """Number of data bytes."""
        return struct.calcsize(">" + self.form)


def _byte(name: str, high: int = 255) -> Packet:
    return Packet(name, "B", 0, high)


def _unsigned(name: str, high: int = 65535) -> Packet:
    return Packet(name, "H", 0, high)


def _signed(name: str, low: int = -32768, high: int = 32767) -> Packet:
    return Packet(name, "h", low, high)


PACKETS: dict[int, Packet] = {
    7: _byte("bumps", 15),
    8: _byte("wall", 1),
    9: _byte("cliff_left", 1),
    10: _byte("cliff_front_left", 1),
    11: _byte("cliff_front_right", 1),
    12: _byte("cliff_right", 1),
    13: _byte("virtual_wall", 1),
    14: _byte("overcurrent", 31),
    15: _byte("dirt"),
    16: _byte("unused_16"),
    17: _byte("infrared"),
    18: _byte("buttons"),
    19: _signed("distance"),
    20: _signed("angle"),
    21: _byte("charging_state", 5),
    22: _unsigned("voltage", 25_000),
    23: _signed("current", -20_000, 20_000),
    24: Packet("temperature", "b", -40, 100),
    25: _unsigned("charge"),
    26: _unsigned("capacity"),
    27: _unsigned("wall_signal", 1023),
    28: _unsigned("cliff_left_signal", 4095),
    29: _unsigned("cliff_front_left_signal", 4095),
    30: _unsigned("cliff_front_right_signal", 4095),
    31: _unsigned("cliff_right_signal", 4095),
    32: _byte("unused_32"),
    33: _unsigned("unused_33"),
    34: _byte("charger", 3),
    35: _byte("mode", 3),
    36: _byte("song"),
    37: _byte("playing", 1),
    38: _byte("stream_packets"),
    39: _signed("velocity"),
    40: _signed("radius"),
    41: _signed("right_velocity"),
    42: _signed("left_velocity"),
    43: _unsigned("left_encoder"),
    44: _unsigned("right_encoder"),
    45: _byte("light_bumper", 63),
    46: _unsigned("light_left", 4095),
    47: _unsigned("light_front_left", 4095),
    48: _unsigned("light_center_left", 4095),
    49: _unsigned("light_center_right", 4095),
    50: _unsigned("light_front_right", 4095),
    51: _unsigned("light_right", 4095),
    52: _byte("infrared_left"),
    53: _byte("infrared_right"),
    54: _signed("left_current"),
    55: _signed("right_current"),
    56: _signed("main_current"),
    57: _signed("side_current"),
    58: _byte("stasis", 3),
}
GROUPS: dict[int, range] = {
    0: range(7, 27),
    1: range(7, 17),
    2: range(17, 21),
    3: range(21, 27),
    4: range(27, 35),
    5: range(35, 43),
    6: range(7, 43),
    100: range(7, 59),
    101: range(43, 59),
    106: range(46, 52),
    107: range(54, 59),
}
"""Packet ids that stand for a sequence of packets."""

_FIXED = {
    **dict.fromkeys((RESET, START, 130, SAFE, FULL, 133, 134, CLEAN, 136, DOCK, STOP), 0),
    **dict.fromkeys((129, 138, PLAY, SENSORS, PAUSE, 165), 1),
    **{DRIVE: 4, LEDS: 3, 144: 3, DIRECT: 4, 146: 4, 162: 2, 163: 4, 164: 4, 167: 15, 168: 3},
}
"""Number of data bytes of each opcode; ``SONG``, ``STREAM`` and ``QUERY`` contain their length."""


# -- to the robot --------------------------------------------------------------------------------------------------


def drive(velocity: int, radius: int) -> bytes:
    """Drive at ``velocity`` mm/s on an arc of ``radius`` mm, left positive; or ``STRAIGHT``; 1 and -1 spin."""
    return struct.pack(">Bhh", DRIVE, velocity, radius)


def drive_direct(right: int, left: int) -> bytes:
    """Turn the wheels at these speeds in mm/s until the next command: the robot has no time-out."""
    return struct.pack(">Bhh", DIRECT, right, left)


def stream(ids: Sequence[int]) -> bytes:
    """Send these packets every ``FRAME_S`` from now on."""
    return bytes((STREAM, len(ids), *ids))


def query(ids: Sequence[int]) -> bytes:
    """Send these packets once, without ids or checksum."""
    return bytes((QUERY, len(ids), *ids))


def pause(going: bool) -> bytes:
    """Pause the stream (False) or resume it (True)."""
    return bytes((PAUSE, int(going)))


def song(number: int, notes: Sequence[tuple[int, int]]) -> bytes:
    """Define song ``number`` (0 to 3): pairs of a MIDI note (31 to 127) and a duration in 1/64 s."""
    return bytes((SONG, number, len(notes), *(part for note in notes for part in note)))


def play(number: int) -> bytes:
    """Play a defined song."""
    return bytes((PLAY, number))


# -- from the robot ------------------------------------------------------------------------------------------------


def packed(packet_id: int, values: Mapping[str, int]) -> bytes:
    """Encode one packet or group as the robot does; values missing in ``values`` are 0."""
    if packet_id in GROUPS:
        return b"".join(packed(one, values) for one in GROUPS[packet_id])
    packet = PACKETS[packet_id]
    return struct.pack(">" + packet.form, values.get(packet.name, 0))


def stream_frame(ids: Sequence[int], values: Mapping[str, int]) -> bytes:
    """Encode one frame of the stream as the robot does."""
    body = b"".join(bytes((one,)) + packed(one, values) for one in ids)
    frame = bytes((HEAD, len(body))) + body
    return frame + bytes((-sum(frame) & 0xFF,))


class StreamReader:
    """Splits the robot's bytes into frames of the packets ``ids``.

    Other data is dropped and counted: boot messages, incomplete frames, wrong checksums, and frames with values out of
    range.
    """

    def __init__(self, ids: Sequence[int]) -> None:
        self.frames = 0
        self.bad_frames = 0
        self._layout: list[tuple[int, int, Packet]] = []
        at = 2
        for one in ids:
            self._layout.append((at, one, PACKETS[one]))
            at += 1 + PACKETS[one].size
        self._command_size = at + 1
        self._head = bytes((HEAD, at - 2))
        self._rest = bytearray()
        self._is_lost = False

    def read(self, data: bytes) -> Iterator[dict[str, int]]:
        """Yield the frames that ``data`` completes, as values by packet name."""
        rest = self._rest
        rest += data
        while True:
            self._skip_to_head()
            if len(rest) < self._command_size:
                return
            # The header bytes can occur within data: checksum and ids decide.
            values = None if sum(rest[: self._command_size]) & 0xFF else self._read_values()
            if values is None:
                self._count_loss()
                del rest[0]
                continue
            del rest[: self._command_size]
            self._is_lost = False
            if all(packet.low <= values[packet.name] <= packet.high for _, _, packet in self._layout):
                self.frames += 1
                yield values
            else:
                self.bad_frames += 1

    def _skip_to_head(self) -> None:
        rest = self._rest
        while rest and not rest.startswith(self._head[: len(rest)]):
            self._count_loss()
            at = rest.find(HEAD, 1)
            del rest[: at if at > 0 else len(rest)]

    def _count_loss(self) -> None:
        # Consecutive bad bytes count once.
        self.bad_frames += not self._is_lost
        self._is_lost = True

    def _read_values(self) -> dict[str, int] | None:
        values: dict[str, int] = {}
        for at, one, packet in self._layout:
            if self._rest[at] != one:
                return None
            (values[packet.name],) = struct.unpack_from(">" + packet.form, self._rest, at + 1)
        return values


@dataclass(frozen=True)
class Command:
    """A command to the robot: an opcode and its data."""

    opcode: int
    data: bytes = b""

    @property
    def words(self) -> tuple[int, ...]:
        """The data as signed numbers of two bytes."""
        return struct.unpack(f">{len(self.data) // 2}h", self.data[: len(self.data) // 2 * 2])


class CommandReader:
    """Splits a stream into commands as the robot does: it waits for missing data without a time-out."""

    def __init__(self) -> None:
        self.unknown = 0
        self._rest = bytearray()

    def read(self, data: bytes) -> Iterator[Command]:
        """Yield the commands that ``data`` completes; bytes that start no command are counted as ``unknown``."""
        rest = self._rest
        rest += data
        while rest:
            size = self._command_size()
            if size is None:
                self.unknown += 1
                del rest[0]
                continue
            if len(rest) < size:
                return
            command = Command(rest[0], bytes(rest[1:size]))
            del rest[:size]
            yield command

    def _command_size(self) -> int | None:
        """Return the size of the first command in bytes.

        None means that it is not a command; more bytes than available means that the size is not known yet.
        """
        rest = self._rest
        opcode = rest[0]
        if opcode in (STREAM, QUERY):
            return 2 + rest[1] if len(rest) > 1 else 2
        if opcode == SONG:
            return 3 + 2 * rest[2] if len(rest) > 2 else 3
        return 1 + _FIXED[opcode] if opcode in _FIXED else None
