"""Tests of ``middleware.consensus.lease.charter``."""

from __future__ import annotations

from dataclasses import replace

import msgpack
from hypothesis import given, settings
from hypothesis import strategies as st

from middleware.consensus.lease.charter import (
    MAX_CHANGES,
    MAX_TOKEN,
    Charter,
    CharterVerifier,
    EndProof,
    create_charter,
    parse_charter,
    parse_end_proof,
    sign_change,
    sign_end,
)
from middleware.entangled.errors import Refused
from middleware.entangled.quorum.ballot import Ballot, highest_credible
from tests.middleware.consensus.lease.room import LeaseCase, T


class CharterTests(LeaseCase):
    def test_chain(self) -> None:
        """A charter contains the newest council, and survives encoding."""
        charter = self.chartered([3, 4, 6], [0, 4, 6])
        again = parse_charter(charter.packed)
        self.assertEqual(again, charter)
        self.assertTrue(charter.is_genuine(T))
        self.assertEqual([self.room.get_place(member) for member in charter.members], [0, 4, 6])
        self.assertEqual((charter.configuration, charter.token, charter.ballot), (3, 7, Ballot(2, "agent")))

    def test_anything_changed(self) -> None:
        """A charter is not genuine if any part of it was changed, or if it has too few signers.

        The parts are the task, the members, their order, the ballot, the token and the signers.
        """
        charter = self.chartered([3, 4, 6], [0, 4, 6])
        first, second = charter.changes
        forged = self.room.identities[6]
        for changes in (
            (second,),
            (second, first),
            (first, second._replace(members=(*second.members[:2], self.room.contacts[2]))),
            (first, second._replace(members=second.members[:2])),
            (first, second._replace(ballot=Ballot(3, "agent"))),
            (first, second._replace(votes=second.votes[:1])),
            (first, second._replace(votes=(second.votes[0], second.votes[0]))),
            (first, second._replace(votes=(second.votes[0], (1, 8, second.votes[1][2])))),
            (first, second._replace(votes=(second.votes[0], (2, 7, second.votes[1][2])))),
            (first, second._replace(votes=(second.votes[0], (9, 7, second.votes[1][2])))),
        ):
            self.assertFalse(replace(charter, changes=changes).is_genuine(T), changes)
        self.assertFalse(charter.is_genuine("t1"))
        self.assertFalse(replace(charter, owner=forged.public).is_genuine(T))
        self.assertFalse(replace(charter, first=tuple(self.room.contacts[:3])).is_genuine(T))

    def test_one_signer_is_no_majority(self) -> None:
        """A council needs the signatures of a majority, and has at least three members."""
        self.assertFalse(self.chartered([3, 4, 6], signers=1).is_genuine(T))
        self.assertFalse(self.chartered([3]).is_genuine(T))

    def test_judge(self) -> None:
        """A charter is rejected if its first council was chosen by a node that may not publish tasks."""
        pinned = create_charter(self.room.identities[0], T, tuple(self.room.contacts[:3]))
        verifier = self.room.charter_verifier
        self.assertIsNone(verifier.parse(T, pinned.packed))
        self.assertEqual(CharterVerifier(lambda public, task_id: True).parse(T, pinned.packed), pinned)
        self.assertIsNone(verifier.parse(T, self.chartered([3, 4, 6], signers=1).packed))

    def test_bounded(self) -> None:
        """The number of links of a charter, and its token, are limited."""
        charter = self.chartered([3, 4, 6])
        full = replace(charter, changes=charter.changes * MAX_CHANGES)
        self.assertRaises(Refused, full.with_change, charter.members, charter.ballot, ())
        self.assertEqual(parse_charter(full.packed), full)
        self.assertIsNone(parse_charter(replace(charter, changes=charter.changes * (MAX_CHANGES + 1)).packed))
        change = charter.changes[0]._replace(votes=((0, 2**61, bytes(64)), (1, 3, bytes(64))))
        self.assertEqual(replace(charter, changes=(change,)).token, MAX_TOKEN)

    def test_ending(self) -> None:
        """The signatures of a majority of the current council prove which agent ended the task, and its token."""
        pinned = self.room.charters[T]
        for charter, positions in ((pinned, [3, 4, 5]), (self.chartered([0, 4, 6]), [0, 4, 6])):
            votes = [
                (place, sign_end(self.room.identities[position], T, charter.configuration, "a", 7))
                for place, position in enumerate(positions)
            ]
            ending = parse_end_proof(EndProof(charter, tuple(votes[:2])).packed, pinned)
            assert ending is not None
            self.assertTrue(ending.is_genuine(T, "a", 7))
            self.assertFalse(ending.is_genuine(T, "a", 8))
            self.assertFalse(ending.is_genuine(T, "b", 7))
            self.assertFalse(ending.is_genuine("t1", "a", 7))
            self.assertFalse(replace(ending, signatures=(votes[0],)).is_genuine(T, "a", 7))
            self.assertFalse(replace(ending, signatures=(votes[0], votes[0])).is_genuine(T, "a", 7))
        other = create_charter(self.room.operator, T, tuple(self.room.contacts[:3]))
        self.assertIsNone(parse_end_proof(EndProof(self.chartered([0, 4, 6]), tuple(votes)).packed, other))

    @settings(max_examples=100)
    @given(st.recursive(st.none() | st.integers() | st.binary(max_size=70) | st.text(), st.lists, max_leaves=20))
    def test_anything_from_the_wire(self, content: object) -> None:
        """Any input is decoded as a charter or as None, without an exception."""
        try:
            packed = bytes(msgpack.packb(content))
        except OverflowError:
            return
        self.assertIsInstance(parse_charter(packed), Charter | None)
        self.assertIsInstance(parse_end_proof(packed, self.chartered()), EndProof | None)
        self.assertIsNone(self.room.charter_verifier.parse(T, content))

    def test_signatures_are_apart(self) -> None:
        """A signature of a council change is not valid for the end of a task, nor the reverse."""
        members = tuple(self.room.contacts[:3])
        identity = self.room.identities[3]
        self.assertNotEqual(sign_change(identity, T, 1, Ballot(7, "a"), members, 7), sign_end(identity, T, 1, "a", 7))


class NumberTests(LeaseCase):
    def test_believed(self) -> None:
        """If only one of three members reports a high number, the number is not believed."""
        self.assertEqual(highest_credible([5, 7, 3], 3), 7)
        self.assertEqual(highest_credible([2**61, 7, 3], 3), 7)
        self.assertEqual(highest_credible([2**61, 2**60], 3), 2**60)
        self.assertEqual(highest_credible([2**61], 1), 2**61)
        self.assertEqual(highest_credible([], 3), 0)
