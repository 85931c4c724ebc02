"""Tests of the wire formats of the AIBO: ``drivers.aibo.codec``, ``menu``, ``picture`` and ``sense``.

Golden vectors are from Tekkotsu 4.0 and 5.x (``WorldStateSerializerBehavior.cc``, ``WalkControllerBehavior.cc``,
``RawCamBehavior.cc``) and from two clients of Tekkotsu 2.x.
"""

from __future__ import annotations

import contextlib
import math
import struct
from dataclasses import replace
from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st
from twisted.trial.unittest import SynchronousTestCase

from drivers.aibo import menu, picture, sensors
from drivers.aibo.codec import (
    MAX_LINE_BYTES,
    T2,
    T4,
    CommandReader,
    LineReader,
    StateReader,
    WorldState,
    encode_command,
    encode_gains,
    encode_state,
    encode_string,
)
from drivers.aibo.menu import Item, Load, MenuReader, Refresh
from drivers.aibo.picture import Block, Closing, Picture, PictureReader, Posture
from drivers.errors import BadFrame
from tests.webnode.picture import jpeg

FELT: dict[str, float | bool | str] = {"range.near": 0.25, "imu.ax": 0.5, "imu.az": 9.75, "power.level": 0.5}
JPEG = jpeg(104, 80)[:-2] + bytes(2524) + b"\xff\xd9"
HEADER = picture.encode_header(0, 1, 104, 80, 121465, 3185)
COLOUR = HEADER + picture.encode_block(Block(104, 80, "JPEGColor", JPEG))
BARE = picture.encode_header(0, 0, 104, 80, 7, 8) + b"".join(
    picture.encode_block(Block(width, height, "RawImage", bytes([channel]) * (width * height), channel))
    for channel, (width, height) in enumerate(((104, 80), (52, 40), (52, 40)))
)


def felt(dialect: str = T4, t: int = 1000) -> WorldState:
    return sensors.make_state(FELT, [0.0] * 18, dialect, t, 4)


class CommandTests(SynchronousTestCase):
    """Commands for walk, head and joints."""

    def test_golden_vectors(self) -> None:
        """Each walk and head command has the five bytes of its golden vector."""
        for letter, value, golden in (
            ("f", 0.5, "66 00 00 00 3f"),
            ("r", -0.25, "72 00 00 80 be"),
            ("s", 1.0, "73 00 00 80 3f"),
            ("t", -0.5, "74 00 00 00 bf"),
            ("p", 1.0, "70 00 00 80 3f"),
        ):
            self.assertEqual(encode_command(letter, value).hex(" "), golden)

    def test_reads_commands_cut_anyhow(self) -> None:
        """The reader returns the same commands for single bytes as for the whole stream."""
        reader = CommandReader()
        stream = encode_command("f", 0.5) + encode_command("r", -0.25)
        seen = [one for at in range(len(stream)) for one in reader.read(stream[at : at + 1])]
        self.assertEqual(seen, [("f", 0.5), ("r", -0.25)])


class LineTests(SynchronousTestCase):
    """Lines of text."""

    def test_drops_a_line_that_never_ends(self) -> None:
        """A line above the maximum length is counted and dropped; the next line is read."""
        reader = LineReader()
        self.assertEqual(list(reader.read(b"on\r\noff")), ["on"])
        self.assertEqual(list(reader.read(b"x" * MAX_LINE_BYTES)), [])
        self.assertEqual(list(reader.read(b"y" * (MAX_LINE_BYTES + 1) + b"\non\n")), ["on"])
        self.assertEqual(reader.bad_lines, 2)


class StateTests(SynchronousTestCase):
    """World state and gains."""

    def test_sizes_and_places(self) -> None:
        """The packets of an ERS-7 have 374, 244 and 224 bytes; each field is at its documented offset."""
        new, old = encode_state(felt()), encode_state(felt(T2))
        self.assertEqual((len(new), len(old)), (374, 244))
        self.assertEqual(len(encode_gains(1, ((1.0, 2.0, 3.0),) * 18)), 224)
        self.assertEqual(new[:6], b"ERS-7\0")
        self.assertEqual(struct.unpack_from("<3I", new, 6), (1000, 4, 47))
        self.assertEqual(struct.unpack_from("<If", new, 206), (11, 250.0))
        self.assertEqual([struct.unpack_from("<I", new, at)[0] for at in (254, 298)], [10, 18])
        self.assertEqual(struct.unpack_from("<2I", old, 0), (1000, 18))
        self.assertEqual([struct.unpack_from("<I", old, at)[0] for at in (80, 128)], [11, 10])

    def test_reads_both_dialects_byte_by_byte(self) -> None:
        """World states of both Tekkotsu versions (dialects) are recognised by their first bytes and decoded.

        The result does not depend on how the stream is split into chunks.
        """
        for dialect in (T4, T2):
            stream = encode_state(felt(dialect)) + encode_state(felt(dialect, 1032))
            for step in (1, 7, len(stream)):
                reader = StateReader()
                seen = [one for at in range(0, len(stream), step) for one in reader.read(stream[at : at + step])]
                self.assertEqual([(one.dialect, one.t) for one in seen], [(dialect, 1000), (dialect, 1032)])
                self.assertEqual(encode_state(seen[0]), stream[: len(stream) // 2])

    def test_takes_counts_from_the_stream(self) -> None:
        """A model with different element counts is decoded with its own counts."""
        other = WorldState(T4, "ERS-210", 5, 6, (1.0,) * 40, (2.0,) * 8, (0.0,) * 8, (0.5,) * 18)
        reader, stream = StateReader(), encode_state(replace(other, model="ERS-210 in red"))
        seen = [one for at in range(len(stream)) for one in reader.read(stream[at : at + 1])]
        self.assertEqual(seen, [replace(other, model="ERS-210 in red")])
        self.assertFalse(sensors.is_known(other))
        self.assertTrue(sensors.is_known(felt()) and sensors.is_known(felt(T2)))

    def test_refuses_what_is_neither_dialect(self) -> None:
        """Invalid counts, an unterminated model name, and bytes of neither dialect raise BadFrame."""
        wild = bytearray(encode_state(felt()))
        wild[14] = wild[15] = 0xFF
        for data in (bytes(wild), b"ERS-" * 20, bytes(40), struct.pack("<II", 5, 17)):
            self.assertRaises(BadFrame, list, StateReader().read(data))

    @settings(deadline=None, max_examples=200)
    @given(st.binary(max_size=600), st.integers(0, 374))
    def test_survives_any_bytes(self, noise: bytes, keep: int) -> None:
        """Random bytes after a valid start give a state or raise BadFrame."""
        for start in (encode_state(felt())[:keep], encode_state(felt(T2))[:keep]):
            with contextlib.suppress(BadFrame):
                list(StateReader().read(start + noise))


class SensorsTests(SynchronousTestCase):
    """Sensor values and their units."""

    def test_names_and_units(self) -> None:
        """Ranges are in metres, the accelerometer points up, currents are in amperes, and all 18 joints have names."""
        seen = sensors.convert_state(next(StateReader().read(encode_state(felt()))))
        self.assertEqual(seen["range.near"], 0.25)
        self.assertTrue(math.isnan(float(seen["range.far"])))
        self.assertEqual((seen["imu.ax"], seen["imu.az"], seen["power.level"]), (0.5, 9.75, 0.5))
        self.assertAlmostEqual(float(seen["power.amps"]), -1.2)
        self.assertEqual(len([key for key in seen if key.startswith("joint.")]), 36)
        self.assertEqual(len([key for key in seen if key.startswith("button.")]), 10)

    def test_refuses_what_cannot_be(self) -> None:
        """Each number that is NaN, infinite or out of range, in any field, raises BadFrame for the whole packet."""
        good = felt()
        for bad in (math.nan, math.inf, -math.inf, 1e9):
            for field in ("outputs", "sensors", "buttons", "duties"):
                changed: dict[str, Any] = {field: (bad, *getattr(good, field)[1:])}
                self.assertRaises(BadFrame, sensors.convert_state, replace(good, **changed))
        self.assertRaises(BadFrame, sensors.convert_state, replace(good, outputs=(0.0,) * 3))


class MenuTests(SynchronousTestCase):
    """The menu protocol of main control."""

    MESSAGES: tuple[menu.Message, ...] = (
        menu.Hello(3),
        menu.OneWordMessage("push"),
        Load("org.tekkotsu.mon.WalkGUI", "WalkGUI", 10050),
        Load("org.tekkotsu.mon.VisionGUI", "RawVisionGUI", 10011, '"raw" "10011" "udp"'),
        menu.OneWordMessage("pop"),
        Refresh("Root", (Item(2, True, "TekkotsuMon", "one\ntwo\nthree"), Item(0, False, "----------"))),
        menu.Status("walking\nagain"),
        menu.Close("WalkGUI"),
        menu.Stack(("Root", "TekkotsuMon")),
        menu.OneWordMessage("goodbye"),
    )

    def test_golden_lines(self) -> None:
        """The messages that start a server and that report an empty slot have the bytes of the golden vectors."""
        self.assertEqual(menu.encode_message(self.MESSAGES[2]), b"load\norg.tekkotsu.mon.WalkGUI\nWalkGUI\n10050\n\n")
        self.assertEqual(
            menu.encode_message(Refresh("Root", (Item(0, False, menu.EMPTY_SLOT),))),
            b"refresh\nRoot\n1\n0\n0\n----------\n0\n\n",
        )

    def test_reads_every_message_byte_by_byte(self) -> None:
        """Each message type survives encoding and decoding."""
        stream = b"".join(menu.encode_message(one) for one in self.MESSAGES)
        for step in (1, len(stream)):
            reader = MenuReader()
            seen = [one for at in range(0, len(stream), step) for one in reader.read(stream[at : at + step])]
            self.assertEqual(tuple(seen), self.MESSAGES)
            self.assertEqual(reader.bad_lines, 0)

    def test_reads_the_menu_of_old_tekkotsu(self) -> None:
        """A menu with four fields per item (Tekkotsu 2) is recognised by its first item, and is read completely."""
        shown = Refresh(
            "Root", (Item(2, True, "Mon", "all servers"), Item(0, False, "7", ""), Item(0, False, "x", "5"))
        )
        stream = menu.encode_message(shown, has_four_fields=True) + menu.encode_message(menu.OneWordMessage("pop"))
        self.assertEqual(list(MenuReader().read(stream)), [shown, menu.OneWordMessage("pop")])

    def test_drops_what_is_no_message(self) -> None:
        """Unknown words, wrong counts and overlong lines are counted, and the next message is read."""
        for bad in (
            "warp",
            "hello\nmany",
            "hello\n" + "9" * 30,
            "refresh\nRoot\n9999",
            "load\na\nb\n99999\nc",
            "\u0663",
        ):
            reader = MenuReader()
            stream = bad.encode() + b"\n" + menu.encode_message(menu.OneWordMessage("pop"))
            self.assertEqual(list(reader.read(stream)), [menu.OneWordMessage("pop")])
            self.assertEqual(reader.bad_lines, 1, bad)
        reader = MenuReader()
        self.assertEqual(list(reader.read(b"x" * 9999 + b"\npop\n")), [menu.OneWordMessage("pop")])
        self.assertEqual(reader.bad_lines, 1)

    def test_drops_a_menu_without_an_end(self) -> None:
        """A menu above the size limit is dropped, and the next message is read."""
        item = "0\n0\nx\n200\n" + "y\n" * 201
        reader = MenuReader()
        list(reader.read(("refresh\nRoot\n200\n" + item * 30).encode()))
        self.assertGreater(reader.bad_lines, 0)
        self.assertEqual(list(reader.read(b"pop\n")), [menu.OneWordMessage("pop")])

    @settings(deadline=None, max_examples=200)
    @given(st.lists(st.sampled_from(["refresh", "status", "load", "0", "1", "5", "", "pop", "x", "\x00"]), max_size=60))
    def test_survives_any_lines(self, lines: list[str]) -> None:
        """No sequence of lines raises an exception."""
        list(MenuReader().read("\n".join([*lines, ""]).encode()))


class PictureTests(SynchronousTestCase):
    """Camera frames."""

    def test_golden_vectors(self) -> None:
        """Names, header and block have the bytes of the golden vectors; a packet with raw channels has 12648 bytes."""
        name = "0d 00 00 00 54 65 6b 6b 6f 74 73 75 49 6d 61 67 65 00"
        self.assertEqual(encode_string("TekkotsuImage").hex(" "), name)
        self.assertEqual(picture.CLOSING.hex(" "), "0f 00 00 00 43 6c 6f 73 65 43 6f 6e 6e 65 63 74 69 6f 6e 00")
        self.assertEqual(
            HEADER.hex(" "),
            name + " 00 00 00 00 01 00 00 00 68 00 00 00 50 00 00 00 79 da 01 00 71 0c 00 00",
        )
        self.assertEqual(
            picture.encode_block(Block(104, 80, "JPEGColor", b""), 2547).hex(" "),
            "08 00 00 00 46 62 6b 49 6d 61 67 65 00 68 00 00 00 50 00 00 00 03 00 00 00 00 00 00 00 "
            "09 00 00 00 4a 50 45 47 43 6f 6c 6f 72 00 f3 09 00 00",
        )
        self.assertEqual(len(BARE), 12648)
        self.assertEqual(picture.REQUEST, b"connection request")

    def test_reads_every_kind_byte_by_byte(self) -> None:
        """Every kind of packet is read however the stream is split into chunks.

        The kinds are JPEGs, raw, single and blank channels, text, and the end of the stream.
        """
        single = picture.encode_header(1, 0, 4, 2, 9, 10) + picture.encode_block(Block(4, 2, "RawImage", bytes(8)))
        jpegs = b"".join(picture.encode_block(Block(4, 2, "JPEGGrayscale", JPEG, n)) for n in range(3))
        blank = picture.encode_block(Block(0, 0, "blank", b"", 1, 0xFFFFFFFF))
        half = (
            picture.encode_header(0, 0, 2, 1, 1, 2)
            + picture.encode_block(Block(2, 1, "RawImage", b"ab"))
            + blank
            + blank
        )
        stream = COLOUR + encode_string("#POS x") + BARE + single + picture.encode_header(0, 1, 4, 2, 11, 12) + jpegs
        stream += half + picture.CLOSING
        for step in (1, 1000, len(stream)):
            reader = PictureReader()
            seen = [one for at in range(0, len(stream), step) for one in reader.read(stream[at : at + step])]
            self.assertEqual(seen[0], Picture(104, 80, 121465, 3185, "jpeg", JPEG))
            self.assertEqual(seen[1], Posture("#POS x"))
            plane = 104 * 80
            planes = bytes(plane) + b"\1" * plane + b"\2" * plane
            self.assertEqual(seen[2], Picture(104, 80, 7, 8, "yuv444", planes))
            self.assertEqual(seen[3], Picture(4, 2, 9, 10, "mono8", bytes(8)))
            self.assertEqual(seen[4], Picture(4, 2, 11, 12, "jpeg", JPEG))
            self.assertEqual(seen[5], Picture(2, 1, 1, 2, "yuv444", b"ab\x80\x80\x80\x80"))
            self.assertEqual(seen[6:], [Closing()])
            self.assertEqual(reader.bad_frames, 0)

    def test_grows_small_channels(self) -> None:
        """Each pixel of a subsampled channel is repeated for all pixels that it covers."""
        parts = (Block(4, 2, "RawImage", b"abcdefgh"), Block(2, 1, "RawImage", b"xy"), Block(2, 1, "RawImage", b"uv"))
        data = picture.encode_header(0, 0, 4, 2, 0, 0) + b"".join(picture.encode_block(one) for one in parts)
        seen = picture.decode_message(data)
        assert isinstance(seen, Picture)
        self.assertEqual(seen.data, b"abcdefgh" + b"xxyyxxyy" + b"uuvvuuvv")

    def test_refuses_datagrams_that_are_no_packet(self) -> None:
        """A datagram with a wrong length or any invalid field raises BadFrame."""
        raw = Block(4, 2, "RawImage", bytes(8))
        head = picture.encode_header(1, 0, 4, 2, 0, 0)
        for data in (
            b"",
            COLOUR[:-1],
            COLOUR + b"\0",
            encode_string("Warp"),
            struct.pack("<I", 2**31),
            encode_string("TekkotsuImage")[:-1] + b"x",
            picture.encode_header(7, 0, 4, 2, 0, 0) + picture.encode_block(raw),
            picture.encode_header(1, 0, 0, 2, 0, 0) + picture.encode_block(raw),
            picture.encode_header(1, 0, 4, 9999, 0, 0) + picture.encode_block(raw),
            head + encode_string("Block"),
            head + picture.encode_block(Block(4, 2, "Warp", b"")),
            head + picture.encode_block(Block(4, 9999, "RawImage", b"")),
            head + picture.encode_block(Block(4, 2, "JPEGColor", b"no picture")),
            head + picture.encode_block(Block(4, 2, "JPEGColor", JPEG), 2**31),
            picture.encode_header(0, 0, 4, 2, 0, 0)
            + picture.encode_block(raw) * 2
            + picture.encode_block(Block(4, 2, "JPEGGrayscale", JPEG)),
        ):
            self.assertRaises(BadFrame, picture.decode_message, data)

    def test_finds_its_way_after_garbage(self) -> None:
        """After invalid bytes the next complete packet is read, also when the bytes arrive one by one."""
        broken = bytearray(COLOUR)
        broken[18] = 9
        stream = bytes(broken) + b"garbage garbage garbage" + COLOUR
        for step in (1, len(stream)):
            reader = PictureReader()
            seen = [one for at in range(0, len(stream), step) for one in reader.read(stream[at : at + step])]
            self.assertEqual([type(one) for one in seen], [Picture])
            self.assertGreater(reader.bad_frames, 0)

    @settings(deadline=None, max_examples=200)
    @given(st.binary(max_size=300), st.integers(0, 200))
    def test_survives_any_bytes(self, noise: bytes, keep: int) -> None:
        """After a valid start, random bytes in a stream raise no exception.

        A datagram of such bytes gives a packet or raises BadFrame.
        """
        list(PictureReader().read(COLOUR[:keep] + noise))
        with contextlib.suppress(BadFrame):
            picture.decode_message(COLOUR[:keep] + noise)
