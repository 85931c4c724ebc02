"""Tests of the messages."""

from __future__ import annotations

from typing import Any

import msgpack
from hypothesis import given, settings
from hypothesis import strategies as st
from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.errors import Malformed
from middleware.entangled.wire.message import Answer, Failure, Message, Question, Told, decoded, encoded

_PLAIN = (
    st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats(allow_nan=False) | st.text(max_size=20)
)
_VALUES = st.recursive(
    _PLAIN | st.binary(max_size=40),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=12,
)


class MessageTests(SynchronousTestCase):
    """Behaviour of ``encoded`` and ``decoded``."""

    @settings(max_examples=150, deadline=None, derandomize=True, database=None)
    @given(number=st.integers(0, 2**64 - 1), value=_VALUES)
    def test_round_trip(self, number: int, value: Any) -> None:
        """Every kind of message comes back as it was."""
        messages: list[Message] = [
            Question(number, "find", (value, 1)),
            Answer(number, value),
            Failure(number, "odd", "no"),
            Told("say", (value,)),
        ]
        for message in messages:
            self.assertEqual(decoded(encoded(message)), message)

    @settings(max_examples=400, deadline=None, derandomize=True, database=None)
    @given(data=st.binary(max_size=200))
    def test_decoded_is_total(self, data: bytes) -> None:
        """Whatever the bytes, there is a message or ``Malformed``."""
        self._decode(data)

    @settings(max_examples=300, deadline=None, derandomize=True, database=None)
    @given(
        fields=_VALUES | st.lists(_VALUES, min_size=2, max_size=5), place=st.integers(0, 200), byte=st.integers(0, 255)
    )
    def test_decoded_is_total_on_near_misses(self, fields: Any, place: int, byte: int) -> None:
        """Lawful msgpack of a wrong shape, and shapes with one byte changed, give a message or ``Malformed``."""
        data = bytearray(msgpack.packb(fields))
        self._decode(bytes(data))
        data[place % len(data)] = byte
        self._decode(bytes(data))

    def _decode(self, data: bytes) -> None:
        try:
            message = decoded(data)
        except Malformed:
            return
        self.assertIsInstance(message, Question | Answer | Failure | Told)

    def test_refuses_what_is_out_of_shape(self) -> None:
        """Wrong ids, names, kinds and lengths, deep nesting, extensions, huge claims and odd map keys are refused."""
        deep: object = 1
        for _ in range(40):
            deep = [deep]
        shapes: list[object] = [
            [],
            [0],
            5,
            None,
            [False, 1, "m", [], 9],
            [1.0, 1, "m"],
            [0, -1, "m", [], 9],
            [0, True, "m", [], 9],
            [0, 1, "", []],
            [0, 1, "m" * 65, []],
            [0, 1, b"m", [], 9],
            [0, 1, "m", {}, 9],
            [0, 1, "m", []],
            [0, 1, "m", [], -1],
            [0, 1, "m", [], 2**32],
            [0, 1, "m", [], True],
            [0, 1, "m", [], 1, 1],
            [1, 1, deep],
            [1, 1.5, 2],
            [2, 1, 256, "x"],
            [2, 1, 1, "x" * 301],
            [2, 1, 1, b"x"],
            [4, "m", [], 9],
            [1, 1, msgpack.ExtType(5, b"x")],
            [1, 1, msgpack.ExtType(5, b"")],
            [1, 1, msgpack.Timestamp(1)],
            [1, 1, {1: 2}],
        ]
        for shape in shapes:
            self.assertRaises(Malformed, decoded, msgpack.packb(shape))
        for data in [
            b"",
            b"\xdd\xff\xff\xff\xff",
            b"\x93\x01\x01\xa1\xff",
            b"\x91" * 1400,
            encoded(Answer(1, 2)) + b"\0",
        ]:
            self.assertRaises(Malformed, decoded, data)

    def test_encoded_refuses_what_cannot_be_packed(self) -> None:
        """An object, and a number beyond 64 bits, are errors of the caller."""
        self.assertRaises(TypeError, encoded, Answer(1, object()))
        self.assertRaises(OverflowError, encoded, Answer(1, 2**64))
