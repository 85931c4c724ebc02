"""Tests of ``drivers.sim.codec``."""

from __future__ import annotations

import msgpack
from hypothesis import example, given
from hypothesis import strategies as st
from twisted.trial.unittest import SynchronousTestCase

from drivers.errors import BadFrame
from drivers.sim.codec import (
    HEADER_BYTES,
    MARKER,
    MAX_PAYLOAD_BYTES,
    CommandResult,
    Drive,
    FrameReader,
    Halt,
    Hello,
    KeepAlive,
    Message,
    Motors,
    Picture,
    Refused,
    Sensors,
    SubscribeWorld,
    WorldCommand,
    WorldSnapshot,
    decode_message,
    encode_message,
)

DOG = {"name": "dog1", "x": 1.0, "y": 2.0, "heading": 0.5, "moving": False, "stripes": 1}
SNAPSHOT = {"t": 1.0, "walls": [3.0, 2.4], "dogs": [DOG], "target": None, "collisions": 0}
MESSAGES: list[Message] = [
    Hello(1, "dog1", 15.0),
    SubscribeWorld(1, 10.0),
    Motors(True),
    Drive(0.1, 0.0, -0.5, 7, 0.5, 12.25),
    Halt(),
    KeepAlive(),
    WorldCommand(3, "move_dog", ("dog1", 1.0, 2.0, 0.0)),
    Sensors(1.5, {"range.near": 0.3, "base.moving": True}, {"imu.ax": (0.1, 0.2, 0.3, 0.4)}, 0),
    Picture(9, 1.5, 208, 160, b"\xff\xd8jpeg"),
    WorldSnapshot(SNAPSHOT),
    CommandResult(3, ""),
    Refused("dog1 is taken", False),
]


def payload(*row: object) -> bytes:
    """Return a payload with these fields, valid or not."""
    return bytes(msgpack.packb(list(row)))


class CodecTests(SynchronousTestCase):
    """Messages are converted to payloads and back."""

    def test_gives_back_every_message(self) -> None:
        """Each message type survives encoding and decoding."""
        self.assertEqual([decode_message(encode_message(message)[HEADER_BYTES:]) for message in MESSAGES], MESSAGES)

    def test_refuses_wrong_fields(self) -> None:
        """Unknown tags and missing, surplus, ill-typed or too large fields raise BadFrame."""
        for bad in (
            b"",
            payload(),
            payload("warp", 1),
            payload(["hello"], 1),
            payload("halt", 1),
            payload("motors", 1),
            payload("hello", 1, "dog1"),
            payload("hello", True, "dog1", 15.0),
            payload("hello", 1, "x" * 201, 15.0),
            payload("drive", float("nan"), 0.0, 0.0, 1, 0.5, 0.0),
            payload("drive", 0.1, 0.0, 0.0, -1, 0.5, 0.0),
            payload("drive", 0.1, 0.0, 0.0, 1.0, 0.5, 0.0),
            payload("drive", 0.1, 0.0, 0.0, 1, float("inf"), 0.0),
            payload("sensors", 1.0, [], {}, 0),
            payload("sensors", 1.0, {}, [], 0),
            payload("sensors", 1.0, {1: 2.0}, {}, 0),
            payload("sensors", 1.0, {"a": None}, {}, 0),
            payload("sensors", 1.0, {"a": 1.0}, {"a": ["x"]}, 0),
            payload("sensors", 1.0, {str(i): 1.0 for i in range(65)}, {}, 0),
            payload("truth", {**SNAPSHOT, "dogs": ({**DOG, "x": "left"},)}),
            payload("truth", {**SNAPSHOT, "target": {"x": 1.0}}),
            payload("truth", {"t": 1.0}),
            payload("truth", {**SNAPSHOT, "walls": (3.0,)}),
            payload("order", 1, "scatter", [[1]]),
        ):
            self.assertRaises(BadFrame, decode_message, bad)

    def test_is_total(self) -> None:
        """Random bytes give a message or raise BadFrame."""

        @given(st.binary(max_size=200))
        @example(b"\x91" * 5000)
        @example(b"\xdf\xff\xff\xff\xff")
        @example(b"\xc1")
        @example(b"\x92\xa4halt\xc7\x05\xff12345")
        @example(payload("hello", 1, "dog1", 15.0) + b"more")
        def check(data: bytes) -> None:
            try:
                message = decode_message(data)
            except BadFrame:
                return
            self.assertIsInstance(message, Message)

        check()

    def test_refuses_to_send_what_nobody_would_take(self) -> None:
        """Encoding a message above the maximum frame size raises ValueError."""
        self.assertRaises(ValueError, encode_message, Picture(1, 1.0, 1, 1, bytes(MAX_PAYLOAD_BYTES)))


class FrameReaderTests(SynchronousTestCase):
    """A stream of bytes is converted to messages."""

    def setUp(self) -> None:
        self.stream = b"".join(encode_message(message) for message in MESSAGES)
        self.reader = FrameReader()

    def test_reads_whole_and_byte_by_byte(self) -> None:
        """The reader returns the same messages however the input is split into chunks."""
        self.assertEqual(list(self.reader.read(self.stream)), MESSAGES)
        pieces = FrameReader()
        read = [message for byte in self.stream for message in pieces.read(bytes([byte]))]
        self.assertEqual(read, MESSAGES)
        self.assertEqual((pieces.frames, pieces.bad_frames), (len(MESSAGES), 0))

    def test_drops_noise_and_goes_on(self) -> None:
        """After invalid bytes the reader finds the next frame, and counts the dropped data."""
        for noise in (
            b"rubbish",
            MARKER + b"\xff\xff\xff\xff",
            b"\xa9",
            MARKER,
            MARKER + (3).to_bytes(4, "big") + b"abc",
        ):
            reader = FrameReader()
            read = list(reader.read(noise + self.stream))
            # Noise that looks like the start of a frame may consume the first real frames, but never all of them.
            self.assertEqual(read, MESSAGES[-len(read) :])
            self.assertGreater(len(read), len(MESSAGES) - 3)
            self.assertGreater(reader.bad_frames, 0)

    def test_keeps_little_of_endless_noise(self) -> None:
        """The buffered size stays limited under endless noise."""
        for _ in range(50):
            self.assertEqual(list(self.reader.read(bytes(10_000))), [])
        self.assertLessEqual(len(self.reader._rest), MAX_PAYLOAD_BYTES + HEADER_BYTES)
        self.assertEqual(list(self.reader.read(self.stream)), MESSAGES)

    def test_survives_any_stream(self) -> None:
        """Random bytes in random pieces give messages or nothing, and raise no exception."""

        @given(
            st.lists(
                st.binary(max_size=60)
                | st.sampled_from([MARKER, encode_message(Halt()), encode_message(KeepAlive())[:5]])
            )
        )
        def check(chunks: list[bytes]) -> None:
            reader = FrameReader()
            for chunk in chunks:
                for message in reader.read(chunk):
                    self.assertIsInstance(message, Message)

        check()
