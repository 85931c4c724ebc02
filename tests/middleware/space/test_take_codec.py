"""Tests of ``middleware.entangled.space.take_codec``: received replies, and votes stored by the previous version."""

from __future__ import annotations

from typing import Any

import msgpack
from hypothesis import given, settings
from hypothesis import strategies as st
from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.quorum.acceptor import Event
from middleware.entangled.quorum.acceptor_log import Floor
from middleware.entangled.quorum.ballot import NO_BALLOT, Ballot
from middleware.entangled.quorum.register import Reply, ReplyKind
from middleware.entangled.space.take_codec import CODEC, pack_reply, unpack_reply
from middleware.entangled.space.tuple_record import TupleId

REPLIES = st.tuples(
    st.sampled_from([ReplyKind.GRANTED, ReplyKind.HELD, ReplyKind.OUTBID, ReplyKind.UNPREPARED]),
    st.integers(0, 2**48 - 1).map(lambda counter: Ballot(counter, b"")),
    st.just(0),
    st.floats(0.0, 600.0),
).map(lambda fields: Reply(*fields))
FOREIGN: Any = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=3) | st.binary(max_size=45),
    lambda inner: st.lists(inner, max_size=5),
    max_leaves=10,
)


class WireTests(SynchronousTestCase):
    @settings(max_examples=100)
    @given(reply=REPLIES, accepted=st.none() | st.integers(1, 2**48 - 1), name=st.binary(min_size=1, max_size=40))
    def test_round_trip(self, reply: Reply, accepted: int | None, name: bytes) -> None:
        """Every reply survives encoding and decoding, for each type of request."""
        if accepted is not None:
            reply = reply._replace(accepted=Ballot(accepted, name), value=name)
        for event in (Event.PREPARE, Event.ACCEPT, Event.RELEASE):
            self.assertEqual(unpack_reply(pack_reply(reply, event), event), reply)

    def test_codes(self) -> None:
        """A reply to one type of request is invalid as a reply to another type."""
        codes = [
            pack_reply(Reply(ReplyKind.GRANTED), event)[0] for event in (Event.PREPARE, Event.ACCEPT, Event.RELEASE)
        ]
        self.assertEqual(codes, [0, 1, 5])
        self.assertEqual(pack_reply(Reply(ReplyKind.SEALED), Event.PREPARE)[0], 0)
        self.assertIsNone(unpack_reply(pack_reply(Reply(ReplyKind.GRANTED), Event.PREPARE), Event.ACCEPT))

    @settings(max_examples=300)
    @given(foreign=FOREIGN, accepted=FOREIGN)
    def test_total(self, foreign: Any, accepted: Any) -> None:
        """Any other input is decoded as None, without an exception."""
        for fields in (foreign, [0, 1, 0.5, accepted], [0, 1, 0.5, [1, b"a", foreign]], [foreign, 1, 0.5, None]):
            reply = unpack_reply(fields, Event.PREPARE)
            self.assertTrue(reply is None or isinstance(reply.kind, ReplyKind))

    def test_out_of_range(self) -> None:
        """Numbers and names out of range are rejected."""
        for fields in (
            [9, 1, 0.5, None], [True, 1, 0.5, None], [0, -1, 0.5, None], [0, 1, 601.0, None],
            [0, 1, float("nan"), None], [0, 1, 1, None], [0, 1, 0.5, [1, b"a"]],
            [0, 1, 0.5, [0, b"a", b"b"]], [0, 1, 0.5, [1, b"", b"b"]],
            [0, 1, 0.5, [1, b"a", b"b" * 41]], [0, 1, 0.5],
        ):  # fmt: skip
            self.assertIsNone(unpack_reply(fields, Event.PREPARE), fields)


class NoteTests(SynchronousTestCase):
    def test_old_notes(self) -> None:
        """Promises, leases and accepted values that the previous version stored are read, and are written unchanged."""
        codec, key, owner = CODEC, b"k" * 20, b"o" * 32
        rows = [
            [key, [owner, "one", b"m" * 8], 3, b"a", 2.5, None],
            [key, [owner, "two", b"n" * 8], 9, b"b", 1.0, [7, b"c", b"value"]],
        ]
        votes, is_whole = codec.unpack(msgpack.packb(rows))
        one, two = (votes[TupleId(key, *fields)] for _, fields, *_ in rows)  # type: ignore[misc]
        self.assertTrue(is_whole)
        self.assertEqual((one.promised, one.reserve, one.accepted), (Ballot(3, b"a"), 2.5, NO_BALLOT))
        self.assertEqual((two.promised, two.accepted, two.value), (Ballot(9, b"b"), Ballot(7, b"c"), b"value"))
        self.assertEqual(codec.pack(votes), msgpack.packb(rows))
        self.assertEqual(codec.unpack_floor((41).to_bytes(8, "big")), Floor(41))
        self.assertEqual(codec.pack_floor(Floor(41)), (41).to_bytes(8, "big"))
        self.assertEqual(codec.bucket_of(TupleId(key, owner, "one", b"m" * 8)), "decree/53")
