"""Tests of ``middleware.entangled.replication.store_reply``."""

from __future__ import annotations

from typing import Any

from hypothesis import given
from hypothesis import strategies as st
from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.record import Record
from middleware.entangled.replication.store_reply import MAX_SEQUENCE, Outcome, StoreReply, decode_reply

RECORD = Record(bytes(20), "x", bytes(32), 7, "team", 60.0, b"\xc0", bytes(64))


class StoreReplyTests(SynchronousTestCase):
    def test_round_trip(self) -> None:
        """Each reply that a replica can give is read as it was meant; the codes are those of the protocol."""
        replies = [StoreReply(each) for each in Outcome if each is not Outcome.SUPERSEDED]
        for reply in [*replies, StoreReply(Outcome.SUPERSEDED, 7), StoreReply(Outcome.SUPERSEDED, MAX_SEQUENCE - 1)]:
            self.assertEqual(decode_reply(reply.encode(), RECORD), reply)
        self.assertEqual([reply.encode() for reply in replies], [0, -1, -2, -3, -4])

    @given(st.integers() | st.booleans() | st.none() | st.floats() | st.text() | st.binary())
    def test_total(self, foreign: Any) -> None:
        """What no replica says is no reply: a lower sequence than that of the record, or anything foreign."""
        reply = decode_reply(foreign, RECORD)
        is_valid = type(foreign) is int and (-4 <= foreign <= 0 or 7 <= foreign < MAX_SEQUENCE)
        self.assertEqual(reply is not None, is_valid)
