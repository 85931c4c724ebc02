"""Codec of iRobot's Open Interface: commands to the robot and sensor packets from it; pure.

Numbers of two bytes are big-endian.  Both sides are implemented: ``encode_stream_frame`` and ``CommandReader`` are for
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
MAX_WHEEL_SPEED_MMPS = 500
"""Maximum speed of a wheel in mm/s."""
STRAIGHT_RADIUS = -0x8000
FRAME_HEADER = 19
MAX_FRAME_BYTES = 172
"""Maximum frame in bytes that a line of 115200 baud transmits within ``FRAME_S``."""


@dataclass(frozen=True)
class Packet:
    """One sensor packet: its name, its ``struct`` format, and its range of valid values."""

    name: str
    struct_format: str
    low: int
    high: int

    @property
    def size(self) -> int:
        """Number of data bytes."""
        return struct.calcsize(">" + self.struct_format)


def _make_byte_packet(name: str, high: int = 255) -> Packet:
    return Packet(name, "B", 0, high)


def _make_unsigned_packet(name: str, high: int = 65535) -> Packet:
    return Packet(name, "H", 0, high)


def _make_signed_packet(name: str, low: int = -32768, high: int = 32767) -> Packet:
    return Packet(name, "h", low, high)


PACKETS: dict[int, Packet] = {
    7: _make_byte_packet("bumps", 15),
    8: _make_byte_packet("wall", 1),
    9: _make_byte_packet("cliff_left", 1),
    10: _make_byte_packet("cliff_front_left", 1),
    11: _make_byte_packet("cliff_front_right", 1),
    12: _make_byte_packet("cliff_right", 1),
    13: _make_byte_packet("virtual_wall", 1),
    14: _make_byte_packet("overcurrent", 31),
    15: _make_byte_packet("dirt"),
    16: _make_byte_packet("unused_16"),
    17: _make_byte_packet("infrared"),
    18: _make_byte_packet("buttons"),
    19: _make_signed_packet("distance"),
    20: _make_signed_packet("angle"),
    21: _make_byte_packet("charging_state", 5),
    22: _make_unsigned_packet("voltage", 25_000),
    23: _make_signed_packet("current", -20_000, 20_000),
    24: Packet("temperature", "b", -40, 100),
    25: _make_unsigned_packet("charge"),
    26: _make_unsigned_packet("capacity"),
    27: _make_unsigned_packet("wall_signal", 1023),
    28: _make_unsigned_packet("cliff_left_signal", 4095),
    29: _make_unsigned_packet("cliff_front_left_signal", 4095),
    30: _make_unsigned_packet("cliff_front_right_signal", 4095),
    31: _make_unsigned_packet("cliff_right_signal", 4095),
    32: _make_byte_packet("unused_32"),
    33: _make_unsigned_packet("unused_33"),
    34: _make_byte_packet("charger", 3),
    35: _make_byte_packet("mode", 3),
    36: _make_byte_packet("song"),
    37: _make_byte_packet("playing", 1),
    38: _make_byte_packet("stream_packets"),
    39: _make_signed_packet("velocity"),
    40: _make_signed_packet("radius"),
    41: _make_signed_packet("right_velocity"),
    42: _make_signed_packet("left_velocity"),
    43: _make_unsigned_packet("left_encoder"),
    44: _make_unsigned_packet("right_encoder"),
    45: _make_byte_packet("light_bumper", 63),
    46: _make_unsigned_packet("light_left", 4095),
    47: _make_unsigned_packet("light_front_left", 4095),
    48: _make_unsigned_packet("light_center_left", 4095),
    49: _make_unsigned_packet("light_center_right", 4095),
    50: _make_unsigned_packet("light_front_right", 4095),
    51: _make_unsigned_packet("light_right", 4095),
    52: _make_byte_packet("infrared_left"),
    53: _make_byte_packet("infrared_right"),
    54: _make_signed_packet("left_current"),
    55: _make_signed_packet("right_current"),
    56: _make_signed_packet("main_current"),
    57: _make_signed_packet("side_current"),
    58: _make_byte_packet("stasis", 3),
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
"""Group ids, each of which stands for a sequence of packets."""

_DATA_LENGTHS = {
    **dict.fromkeys((RESET, START, 130, SAFE, FULL, 133, 134, CLEAN, 136, DOCK, STOP), 0),
    **dict.fromkeys((129, 138, PLAY, SENSORS, PAUSE, 165), 1),
    **{DRIVE: 4, LEDS: 3, 144: 3, DIRECT: 4, 146: 4, 162: 2, 163: 4, 164: 4, 167: 15, 168: 3},
}
"""Number of data bytes of each opcode; ``SONG``, ``STREAM`` and ``QUERY`` contain their length."""


# -- to the robot --------------------------------------------------------------------------------------------------


def encode_drive(velocity: int, radius: int) -> bytes:
    """Drive at ``velocity`` mm/s on an arc of ``radius`` mm, left positive, or straight (``STRAIGHT_RADIUS``).

    The radius 1 turns on the spot to the left, -1 to the right.
    """
    return struct.pack(">Bhh", DRIVE, velocity, radius)


def encode_drive_direct(right: int, left: int) -> bytes:
    """Turn the wheels at these speeds in mm/s until the next command: the robot has no time-out."""
    return struct.pack(">Bhh", DIRECT, right, left)


def encode_stream(ids: Sequence[int]) -> bytes:
    """Send these packets every ``FRAME_S`` from now on."""
    return bytes((STREAM, len(ids), *ids))


def encode_query(ids: Sequence[int]) -> bytes:
    """Send these packets once, without ids or checksum."""
    return bytes((QUERY, len(ids), *ids))


def encode_pause(going: bool) -> bytes:
    """Pause the stream (False) or resume it (True)."""
    return bytes((PAUSE, int(going)))


def encode_song(number: int, notes: Sequence[tuple[int, int]]) -> bytes:
    """Define song ``number`` (0 to 3): pairs of a MIDI note (31 to 127) and a duration in 1/64 s."""
    return bytes((SONG, number, len(notes), *(part for note in notes for part in note)))


def encode_play(number: int) -> bytes:
    """Play a defined song."""
    return bytes((PLAY, number))


# -- from the robot ------------------------------------------------------------------------------------------------


def encode_packet(packet_id: int, values: Mapping[str, int]) -> bytes:
    """Encode one packet or group as the robot does; values missing in ``values`` are 0."""
    if packet_id in GROUPS:
        return b"".join(encode_packet(one, values) for one in GROUPS[packet_id])
    packet = PACKETS[packet_id]
    return struct.pack(">" + packet.struct_format, values.get(packet.name, 0))


def encode_stream_frame(ids: Sequence[int], values: Mapping[str, int]) -> bytes:
    """Encode one frame of the stream as the robot does."""
    body = b"".join(bytes((one,)) + encode_packet(one, values) for one in ids)
    frame = bytes((FRAME_HEADER, len(body))) + body
    return frame + bytes((-sum(frame) & 0xFF,))


class StreamReader:
    """Splits the robot's bytes into frames of the packets ``ids``.

    All other data is dropped and counted: boot messages, incomplete frames, wrong checksums, and values out of range.
    """

    def __init__(self, ids: Sequence[int]) -> None:
        self.frames = 0
        self.bad_frames = 0
        self._layout: list[tuple[int, int, Packet]] = []
        at = 2
        for one in ids:
            self._layout.append((at, one, PACKETS[one]))
            at += 1 + PACKETS[one].size
        self._frame_size = at + 1
        self._head = bytes((FRAME_HEADER, at - 2))
        self._rest = bytearray()
        self._is_resyncing = False

    def read(self, data: bytes) -> Iterator[dict[str, int]]:
        """Yield the frames that ``data`` completes, as values by packet name."""
        rest = self._rest
        rest += data
        while True:
            self._skip_to_head()
            if len(rest) < self._frame_size:
                return
            # The header bytes can also occur within data: only a frame with the right checksum and ids is accepted.
            values = None if sum(rest[: self._frame_size]) & 0xFF else self._read_values()
            if values is None:
                self._count_loss()
                del rest[0]
                continue
            del rest[: self._frame_size]
            self._is_resyncing = False
            if all(packet.low <= values[packet.name] <= packet.high for _, _, packet in self._layout):
                self.frames += 1
                yield values
            else:
                self.bad_frames += 1

    def _skip_to_head(self) -> None:
        rest = self._rest
        while rest and not rest.startswith(self._head[: len(rest)]):
            self._count_loss()
            at = rest.find(FRAME_HEADER, 1)
            del rest[: at if at > 0 else len(rest)]

    def _count_loss(self) -> None:
        # Consecutive bad bytes are counted once.
        self.bad_frames += not self._is_resyncing
        self._is_resyncing = True

    def _read_values(self) -> dict[str, int] | None:
        values: dict[str, int] = {}
        for at, one, packet in self._layout:
            if self._rest[at] != one:
                return None
            (values[packet.name],) = struct.unpack_from(">" + packet.struct_format, self._rest, at + 1)
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
    """Splits a stream into commands as the robot does: it waits for missing data for an unlimited time."""

    def __init__(self) -> None:
        self.unknown = 0
        self._rest = bytearray()

    def read(self, data: bytes) -> Iterator[Command]:
        """Yield the commands that ``data`` completes; bytes that do not start a command are counted as ``unknown``."""
        rest = self._rest
        rest += data
        while rest:
            size = self._find_command_size()
            if size is None:
                self.unknown += 1
                del rest[0]
                continue
            if len(rest) < size:
                return
            command = Command(rest[0], bytes(rest[1:size]))
            del rest[:size]
            yield command

    def _find_command_size(self) -> int | None:
        """Return the size of the first command in bytes.

        None: the data does not start with a command. A size larger than the data: the command is incomplete.
        """
        rest = self._rest
        opcode = rest[0]
        if opcode in (STREAM, QUERY):
            return 2 + rest[1] if len(rest) > 1 else 2
        if opcode == SONG:
            return 3 + 2 * rest[2] if len(rest) > 2 else 3
        return 1 + _DATA_LENGTHS[opcode] if opcode in _DATA_LENGTHS else None
