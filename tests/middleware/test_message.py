"""Tests of the encoding of messages."""

from __future__ import annotations

from typing import Any

import msgpack
from hypothesis import given, settings
from hypothesis import strategies as st
from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.errors import Malformed
from middleware.entangled.wire.message import Answer, Cancel, Failure, Message, Notification, Request, decode, encode

_PLAIN = (
    st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats(allow_nan=False) | st.text(max_size=20)
)
_VALUES = st.recursive(
    _PLAIN | st.binary(max_size=40),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=12,
)


def by_the_table(kind: object, fields: list[Any]) -> Message | None:
    """Decode fields by the table of ``docs/reference/wire-protocol.md``, in a simple implementation with patterns."""
    if type(kind) is not int or any(deep(field) > 15 for field in fields):
        return None
    match [kind, *fields]:
        case [0, int(id_), int(behind), str(method), list(arguments), int(left)]:
            numbers = not any(isinstance(number, bool) for number in (id_, behind, left))
            if numbers and 0 <= behind <= id_ < 2**64 and 0 <= left < 2**32 and 0 < len(method) <= 64:
                return Request(id_, method, tuple(arguments), left, behind)
        case [1, int(id_), value] if not isinstance(id_, bool) and 0 <= id_ < 2**64:
            return Answer(id_, value)
        case [2, int(id_), str(code), str(text)] if not isinstance(id_, bool) and 0 <= id_ < 2**64:
            if 0 < len(code) <= 64 and code.isascii() and code.isprintable() and len(text) <= 300:
                return Failure(id_, code, text)
        case [3, str(method), list(arguments)] if 0 < len(method) <= 64:
            return Notification(method, tuple(arguments))
        case [4, int(id_)] if not isinstance(id_, bool) and 0 <= id_ < 2**64:
            return Cancel(id_)
    return None


def deep(value: object) -> int:
    """Return the nesting depth of a value."""
    inside = value if isinstance(value, list) else list(value.values()) if isinstance(value, dict) else []
    return 1 + max(map(deep, inside), default=0)


class MessageTests(SynchronousTestCase):
    """Tests of ``encode`` and ``decode``."""

    @settings(max_examples=150)
    @given(number=st.integers(0, 2**64 - 1), value=_VALUES)
    def test_round_trip(self, number: int, value: Any) -> None:
        """Every kind of message survives encoding and decoding."""
        messages: list[Message] = [
            Request(number, "find", (value, 1)),
            Request(number, "find", (value, 1), 5, number // 2),
            Answer(number, value),
            Failure(number, "odd", "no"),
            Notification("say", (value,)),
        ]
        for message in messages:
            self.assertEqual(decode(encode(message)), message)

    @settings(max_examples=400)
    @given(
        kind=st.sampled_from([0, 1, 2, 3, 4, 5, True, 1.0]),
        fields=st.lists(
            st.sampled_from([0, 1, 7, -1, True, 2.0, 2**32, "m", "", "busy", "x" * 65, "x" * 301, b"m", None, [], {}])
            | _VALUES,
            max_size=6,
        ),
    )
    def test_decoded_reads_as_the_table_says(self, kind: Any, fields: list[Any]) -> None:
        """``decode`` accepts exactly the messages in the table of ``docs/reference/wire-protocol.md``."""
        try:
            found: Message | None = decode(msgpack.packb([kind, *fields]))
        except Malformed:
            found = None
        self.assertEqual(found, by_the_table(kind, fields))

    def test_refuses_what_is_out_of_shape(self) -> None:
        """Any other input is rejected, such as deep nesting, extension types, wrong lengths and non-text map keys."""
        deep: object = 1
        deep_maps: object = 1
        for _ in range(40):
            deep, deep_maps = [deep], {"in": deep_maps}
        shapes: list[object] = [
            [],
            5,
            None,
            [0, 1, 0, "m" * 65, [], 9],
            [0, 1, 0, "m", [], 1, 1],
            [1, 1, deep],
            [1, 1, deep_maps],
            [1, 1, msgpack.ExtType(5, b"x")],
            [1, 1, msgpack.ExtType(5, b"")],
            [1, 1, msgpack.Timestamp(1)],
            [1, 1, {1: 2}],
        ]
        for shape in shapes:
            self.assertRaises(Malformed, decode, msgpack.packb(shape))
        for data in [
            b"",
            b"\xdd\xff\xff\xff\xff",
            b"\x93\x01\x01\xa1\xff",
            b"\x91" * 1400,
            encode(Answer(1, 2)) + b"\0",
        ]:
            self.assertRaises(Malformed, decode, data)

    def test_encoded_refuses_what_cannot_be_packed(self) -> None:
        """``encode`` raises ``TypeError`` for an object and ``OverflowError`` for a number beyond 64 bits."""
        self.assertRaises(TypeError, encode, Answer(1, object()))
        self.assertRaises(OverflowError, encode, Answer(1, 2**64))
