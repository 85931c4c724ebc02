"""Tests of ``middleware.consensus.lease.lease_codec``."""

from __future__ import annotations

import zlib

import msgpack
from hypothesis import given, settings
from hypothesis import strategies as st
from twisted.trial.unittest import SynchronousTestCase

from middleware.consensus.lease.lease_codec import (
    BALLOT_MODULUS,
    CODEC,
    MAX_COUNCIL,
    pack_reply,
    parse_members,
    parse_reply,
)
from middleware.entangled.contact import Contact
from middleware.entangled.network.network import Address
from middleware.entangled.quorum.acceptor_log import Floor
from middleware.entangled.quorum.ballot import Ballot
from middleware.entangled.quorum.register import Reply, ReplyKind

MEMBERS = tuple(Contact(bytes([n]) * 32, Address("10.0.0.1", 7000 + n)) for n in range(MAX_COUNCIL + 1))
ANYTHING = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8) | st.binary(max_size=40),
    lambda inner: st.lists(inner, max_size=8) | st.dictionaries(st.text(max_size=3), inner, max_size=3),
    max_leaves=12,
)


class BallotTests(SynchronousTestCase):
    def test_lives(self) -> None:
        """Two ballots have the same owner only if they are from the same agent, without a restart in between."""
        one = Ballot(3 * BALLOT_MODULUS + 7, "a")
        self.assertTrue(one.is_same_life(Ballot(9 * BALLOT_MODULUS + 7, "a"), BALLOT_MODULUS))
        self.assertFalse(one.is_same_life(Ballot(3 * BALLOT_MODULUS + 7, "b"), BALLOT_MODULUS))
        self.assertFalse(one.is_same_life(Ballot(3 * BALLOT_MODULUS + 8, "a"), BALLOT_MODULUS))


class ReplyTests(SynchronousTestCase):
    def test_there_and_back(self) -> None:
        """Replies of every kind survive packing and unpacking."""
        for kind in ReplyKind:
            reply = Reply(kind, Ballot(5, "a"), 3, 1.25, 2)
            if kind is ReplyKind.SEALED:
                reply = reply._replace(accepted=reply.promised, value=MEMBERS[:3])
            self.assertEqual(parse_reply(pack_reply(reply)), reply)

    def test_strange_durations(self) -> None:
        """An invalid duration is read as 0."""
        for strange in (-1.0, float("nan")):
            read = parse_reply(["granted", 1, "a", 1, strange, 1, []])
            assert read is not None
            self.assertEqual(read.remaining, 0.0)

    def test_unlawful(self) -> None:
        """Any other content is not decoded as a reply."""
        good = pack_reply(Reply(ReplyKind.GRANTED, Ballot(5, "a"), 3, 1.25, 2))
        for place, bad in (
            (0, "yes"),
            (0, 1),
            (1, -1),
            (1, True),
            (1, 2**62),
            (2, 5),
            (3, 1.0),
            (4, 1),
            (5, "1"),
            (6, 0),
        ):
            self.assertIsNone(parse_reply([*good[:place], bad, *good[place + 1 :]]), (place, bad))
        others: tuple[object, ...] = (None, 5, [], good[:-1], [*good, 0], {})
        for other in others:
            self.assertIsNone(parse_reply(other))

    def test_councils(self) -> None:
        """A council is decoded if it consists of a limited number of distinct contacts."""
        packed = [member.pack() for member in MEMBERS]
        self.assertEqual(parse_members(packed[:MAX_COUNCIL]), MEMBERS[:MAX_COUNCIL])
        for bad in (packed, [packed[0], packed[0]], [[b"k", "h", 1]], [1], None, b"x"):
            self.assertIsNone(parse_members(bad))

    @settings(max_examples=300)
    @given(ANYTHING)
    def test_total(self, answer: object) -> None:
        """Any answer of a peer is decoded as a reply or as None, without an exception."""
        read = parse_reply(answer)
        self.assertTrue(read is None or read.remaining >= 0.0)
        parse_members(answer)


class NoteTests(SynchronousTestCase):
    """Tests of reading entries that earlier versions of the program stored."""

    def test_old_notes(self) -> None:
        """Promises, leases, accepted values and closes are read from rows with and without proof and grantee."""
        codec, members = CODEC, [member.pack() for member in MEMBERS[:3]]
        row = [2, [9, "b", 7, "a", 5, "c", 9, "b"], 4, 1.5, members, True, b"proof", "d"]
        for length, proof, grantee in ((6, b"", "a"), (7, b"proof", "a"), (8, b"proof", "d")):
            registers, is_whole = codec.unpack(msgpack.packb({"t": row[:length]}))
            self.assertTrue(is_whole)
            found = registers["t"]
            ballots = found.promised, found.holder, found.released, found.accepted
            self.assertEqual(ballots, (Ballot(9, "b"), Ballot(7, "a"), Ballot(5, "c"), Ballot(9, "b")))
            self.assertEqual((found.configuration, found.token, found.ttl, found.value), (2, 4, 1.5, MEMBERS[:3]))
            self.assertEqual((found.is_closed, found.proof, found.grantee), (True, proof, grantee))
        self.assertEqual(codec.pack(registers), msgpack.packb({"t": row}))
        self.assertEqual(codec.bucket_of("t"), f"lease/{zlib.crc32(b't') % 64}")

    def test_old_floors(self) -> None:
        """The lower bounds of both earlier versions are read, as one number or as two."""
        self.assertEqual(CODEC.unpack_floor(msgpack.packb([40, 2.0])), Floor(40, 40, 2.0))
        self.assertEqual(CODEC.unpack_floor(msgpack.packb([40, 2.0, 7])), Floor(40, 7, 2.0))
        self.assertEqual(CODEC.pack_floor(Floor(40, 7, 2.0)), msgpack.packb([40, 2.0, 7]))
        self.assertEqual([CODEC.unpack_floor(corrupt) for corrupt in (None, b"?", msgpack.packb([1]))], [None] * 3)
