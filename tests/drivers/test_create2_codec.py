"""Tests of ``drivers.create2.codec``, ``odometry``, ``sensors`` and ``option``."""

from __future__ import annotations

import math
from typing import get_args

from hypothesis import given, settings
from hypothesis import strategies as st
from twisted.trial.unittest import SynchronousTestCase

from drivers.create2 import codec
from drivers.create2.codec import (
    GROUPS,
    PACKETS,
    Command,
    CommandReader,
    StreamReader,
    encode_packet,
    encode_stream_frame,
)
from drivers.create2.odometry import MM_PER_COUNT, WHEEL_BASE_MM, Odometry
from drivers.create2.option import Baud
from drivers.create2.sensors import PACKET_IDS, convert_frame, describe_safety_event
from drivers.errors import UsageError
from drivers.registry import describe

SPECIFIED = bytes((19, 5, 29, 2, 25, 13, 0, 163))
"""The example frame of the vendor's specification (page of opcode 148)."""


def values_of(ids: tuple[int, ...]) -> st.SearchStrategy[dict[str, int]]:
    """Generate valid values for these packets."""
    packets = [PACKETS[one] for one in ids]
    return st.fixed_dictionaries({packet.name: st.integers(packet.low, packet.high) for packet in packets})


class CommandTests(SynchronousTestCase):
    """Commands to the robot."""

    def test_golden_vectors(self) -> None:
        """Each command has the bytes of the Open Interface specification."""
        self.assertEqual(codec.encode_drive_direct(200, 200), bytes((145, 0, 200, 0, 200)))
        self.assertEqual(codec.encode_drive_direct(-100, 100), bytes((145, 255, 156, 0, 100)))
        self.assertEqual(codec.encode_drive(200, codec.STRAIGHT_RADIUS), bytes((137, 0, 200, 128, 0)))
        self.assertEqual(codec.encode_drive(150, 1), bytes((137, 0, 150, 0, 1)))
        self.assertEqual(codec.encode_drive(150, -1), bytes((137, 0, 150, 255, 255)))
        self.assertEqual(codec.encode_stream((29, 13)), bytes((148, 2, 29, 13)))
        self.assertEqual(codec.encode_query((29, 13)), bytes((149, 2, 29, 13)))
        self.assertEqual(codec.encode_pause(False) + codec.encode_pause(True), bytes((150, 0, 150, 1)))
        self.assertEqual(codec.encode_song(0, [(69, 32)]) + codec.encode_play(0), bytes((140, 0, 1, 69, 32, 141, 0)))

    def test_robot_hears_each_command_however_it_is_cut(self) -> None:
        """Single bytes give the same commands as the whole input."""
        said = (
            bytes((128, 131))
            + codec.encode_drive(-300, 1000)
            + codec.encode_song(1, [(60, 8), (62, 8)])
            + codec.encode_stream(PACKET_IDS)
        )
        said += codec.encode_query((100,)) + bytes((142, 7, 139, 1, 2, 3, 255, 173))
        whole = CommandReader()
        commands = list(whole.read(said))
        pieces = CommandReader()
        self.assertEqual([one for at in range(len(said)) for one in pieces.read(said[at : at + 1])], commands)
        self.assertEqual(commands[2], Command(137, said[3:7]))
        self.assertEqual(commands[2].words, (-300, 1000))
        self.assertEqual([one.opcode for one in commands], [128, 131, 137, 140, 148, 149, 142, 139, 173])
        self.assertEqual((whole.unknown, pieces.unknown), (1, 1))

    def test_robot_waits_for_missing_data(self) -> None:
        """An incomplete command takes the next bytes as its data, like the real robot; five start bytes end this."""
        reader = CommandReader()
        self.assertEqual(list(reader.read(codec.encode_drive_direct(100, 100)[:1])), [])
        self.assertEqual([one.opcode for one in reader.read(bytes((128,)) * 5)], [145, 128])

    @given(st.binary(max_size=200))
    @settings(max_examples=200, deadline=None)
    def test_robot_takes_any_bytes(self, data: bytes) -> None:
        """For any bytes the robot's reader raises no exception, and uses each byte at most once."""
        reader = CommandReader()
        heard = sum(1 + len(one.data) for one in reader.read(data))
        self.assertLessEqual(heard + reader.unknown, len(data))


class StreamTests(SynchronousTestCase):
    """Frames from the robot."""

    def test_golden_frame_of_the_specification(self) -> None:
        """The specification's example frame decodes to 2 * 256 + 25 = 537, and encodes to the same bytes."""
        reader = StreamReader((29, 13))
        self.assertEqual(list(reader.read(SPECIFIED)), [{"cliff_front_left_signal": 537, "virtual_wall": 0}])
        self.assertEqual(encode_stream_frame((29, 13), {"cliff_front_left_signal": 537}), SPECIFIED)
        self.assertEqual((reader.frames, reader.bad_frames), (1, 0))

    def test_sizes_of_packets_and_groups(self) -> None:
        """Groups have the specified lengths, which shows that the packet sizes and offsets are right."""
        sizes = {0: 26, 1: 10, 2: 6, 3: 10, 4: 14, 5: 12, 6: 52, 100: 80, 101: 28, 106: 12, 107: 9}
        self.assertEqual({one: len(encode_packet(one, {})) for one in GROUPS}, sizes)
        offsets = {7: 0, 17: 10, 19: 12, 22: 17, 27: 26, 34: 39, 35: 40, 43: 52, 46: 57, 52: 69, 58: 79}
        for one, offset in offsets.items():
            self.assertEqual(sum(PACKETS[before].size for before in range(7, one)), offset)

    @given(values_of(PACKET_IDS), st.integers(1, 90))
    @settings(max_examples=100, deadline=None)
    def test_reads_what_is_written(self, values: dict[str, int], size: int) -> None:
        """Each frame is unchanged by encoding and decoding, also in pieces and with the header byte 19 in its data."""
        data = encode_stream_frame(PACKET_IDS, values) * 2
        reader = StreamReader(PACKET_IDS)
        got = [frame for at in range(0, len(data), size) for frame in reader.read(data[at : at + size])]
        self.assertEqual(got, [values, values])
        self.assertEqual(reader.bad_frames, 0)

    def test_fed_one_byte_at_a_time_with_heads_within(self) -> None:
        """If a stream starts in the middle of a frame and arrives byte by byte, the next frames are found.

        This also holds if their data contains header bytes.
        """
        values = {"left_encoder": 19 * 256 + 78, "right_encoder": 19 * 256 + 78, "charge": 19 * 256 + 78}
        data = encode_stream_frame(PACKET_IDS, values)
        reader = StreamReader(PACKET_IDS)
        stream = data[30:] + data * 3
        got = [frame for at in range(len(stream)) for frame in reader.read(stream[at : at + 1])]
        self.assertEqual(len(got), 3)
        self.assertEqual(reader.bad_frames, 1)

    def test_counts_and_skips_what_is_no_frame(self) -> None:
        """An invalid byte destroys one frame; the text that the robot prints at a reboot destroys none.

        The following frames are read.
        """
        data = encode_stream_frame((29, 13), {"virtual_wall": 1})
        reader = StreamReader((29, 13))
        spoilt = data[:3] + bytes((data[3] ^ 8,)) + data[4:]
        self.assertEqual(len(list(reader.read(data + spoilt + data))), 2)
        self.assertEqual((reader.frames, reader.bad_frames), (2, 1))
        self.assertEqual(len(list(reader.read(b"bl-start\r\nrelease-3.5.4\r\n" + data))), 1)
        self.assertEqual((reader.frames, reader.bad_frames), (3, 2))

    def test_refuses_other_packets_with_a_right_checksum(self) -> None:
        """A frame that contains other packets is refused, even if its length and checksum are right."""
        reader = StreamReader((29, 13))
        self.assertEqual(list(reader.read(encode_stream_frame((28, 13), {}))), [])
        self.assertEqual(reader.bad_frames, 1)

    def test_refuses_what_no_robot_can_mean(self) -> None:
        """A frame that contains mode 9 or a battery voltage of 60 V is dropped and counted."""
        reader = StreamReader((35, 22))
        for values in ({"mode": 9}, {"voltage": 60_000}):
            self.assertEqual(list(reader.read(encode_stream_frame((35, 22), values))), [])
        self.assertEqual((reader.frames, reader.bad_frames), (0, 2))
        self.assertEqual(len(list(reader.read(encode_stream_frame((35, 22), {"mode": 2})))), 1)

    @given(st.lists(st.one_of(st.binary(max_size=40), st.just(SPECIFIED), st.just(SPECIFIED[:5])), max_size=12))
    @settings(max_examples=200, deadline=None)
    def test_takes_any_bytes(self, pieces: list[bytes]) -> None:
        """Any bytes raise no exception, and of two frames that follow them at least one is read."""
        reader = StreamReader((29, 13))
        for piece in pieces:
            list(reader.read(piece))
        self.assertTrue(list(reader.read(SPECIFIED * 2)))


class SensorsTests(SynchronousTestCase):
    """The meaning of a frame."""

    def frame(self, **values: int) -> dict[str, int]:
        return next(StreamReader(PACKET_IDS).read(encode_stream_frame(PACKET_IDS, {"capacity": 2000, **values})))

    def test_each_bit_has_its_side(self) -> None:
        """The bits of bumpers, wheel drops, light and buttons are in the specified order: right before left."""
        felt = convert_frame(self.frame(bumps=0b0101, light_bumper=0b100001, buttons=0b00000100))
        self.assertEqual((felt["bump.right"], felt["bump.left"]), (True, False))
        self.assertEqual((felt["wheeldrop.right"], felt["wheeldrop.left"]), (True, False))
        self.assertEqual((felt["lightbump.left.hit"], felt["lightbump.right.hit"]), (True, True))
        self.assertIs(felt["lightbump.front_left.hit"], False)
        self.assertEqual((felt["button.dock"], felt["button.clean"]), (1.0, 0.0))

    def test_power_in_si_units(self) -> None:
        """Power values are in SI units; a negative current discharges the battery.

        Without a capacity there is no level.
        """
        felt = convert_frame(self.frame(voltage=14400, current=-250, temperature=-5, charge=500, charging_state=2))
        self.assertEqual((felt["power.volts"], felt["power.amps"], felt["power.celsius"]), (14.4, -0.25, -5.0))
        self.assertEqual((felt["power.level"], felt["power.charging"]), (0.25, True))
        self.assertNotIn("power.level", convert_frame(self.frame(capacity=0)))

    def test_names_the_causes_of_a_safety_event(self) -> None:
        """The causes of a safety event are listed by the keys of the observation."""
        felt = convert_frame(self.frame(bumps=8, cliff_left=1))
        self.assertEqual(describe_safety_event(felt), "cliff.left, wheeldrop.left")
        self.assertEqual(describe_safety_event(convert_frame(self.frame(charger=2))), "charger")
        self.assertEqual(describe_safety_event(convert_frame(self.frame())), "mode")


class OdometryTests(SynchronousTestCase):
    """The pose from the wheel encoders."""

    def test_goes_straight_and_turns(self) -> None:
        """Equal counts on both wheels move the pose straight ahead; opposite counts turn it left on the spot."""
        where = Odometry()
        metre = round(1000.0 / MM_PER_COUNT)
        for step in range(101):
            where.update(metre * step // 100, metre * step // 100, step * 0.03)
        self.assertAlmostEqual(where.x, 1.0, places=3)
        self.assertAlmostEqual(where.vx, 1.0 / 3.0, places=1)
        quarter = round(math.pi / 4.0 * WHEEL_BASE_MM / MM_PER_COUNT)
        for step in range(101):
            where.update((metre - quarter * step // 100) % 65536, metre + quarter * step // 100, 4.0 + step * 0.03)
        self.assertAlmostEqual(where.yaw, math.pi / 2.0, places=2)
        self.assertAlmostEqual(where.x, 1.0, places=2)
        self.assertGreater(where.wz, 0.4)

    def test_counters_wrap(self) -> None:
        """A counter that wraps in either direction gives a small step, not a jump."""
        where = Odometry()
        where.update(65530, 65530, 0.0)
        where.update(4, 4, 0.1)
        self.assertAlmostEqual(where.x, 10 * MM_PER_COUNT / 1000.0)
        where.update(65530, 65530, 0.2)
        self.assertAlmostEqual(where.x, 0.0)
        self.assertEqual(where.jumps, 0)

    def test_draws_arcs(self) -> None:
        """After a half circle with a radius of one metre the pose is two metres to the left."""
        where = Odometry()
        for step in range(33):
            left, right = (math.pi * (1.0 + side * 0.1175) * step / 32 / MM_PER_COUNT * 1000.0 for side in (-1, 1))
            where.update(round(left), round(right), step * 1.0)
        self.assertAlmostEqual(where.x, 0.0, places=2)
        self.assertAlmostEqual(where.y, 2.0, places=2)
        self.assertAlmostEqual(abs(where.yaw), math.pi, places=2)

    def test_jumps_move_nothing(self) -> None:
        """A counter step beyond the wheel's speed, such as after a reboot, counts as a jump and moves nothing."""
        where = Odometry()
        where.update(20_000, 20_000, 0.0)
        where.update(0, 0, 0.015)
        self.assertEqual((where.x, where.jumps), (0.0, 1))
        where.update(10, 10, 0.03)
        self.assertAlmostEqual(where.x, 10 * MM_PER_COUNT / 1000.0)


class OptionTests(SynchronousTestCase):
    """The options of the Create 2."""

    def test_every_baud_carries_the_stream(self) -> None:
        """At each permitted baud rate (10 bits per byte) a frame fits into the stream's interval."""
        size = len(encode_stream_frame(PACKET_IDS, {}))
        self.assertEqual(size, 81)
        for baud in get_args(Baud):
            self.assertLess(size * 10 / baud, codec.FRAME_S, str(baud))
        self.assertRaises(UsageError, describe, "create2", {"port": "/dev/ttyUSB0", "baud": 19200})
