"""Tests of ``middleware.consensus.lease.charter``."""

from __future__ import annotations

from dataclasses import replace

import msgpack
from hypothesis import given, settings
from hypothesis import strategies as st

from middleware.consensus.lease.charter import (
    MAX_LINKS,
    MAX_TOKEN,
    Charter,
    Ending,
    Judge,
    charter_of,
    ending_of,
    pin,
    sign_change,
    sign_end,
)
from middleware.entangled.errors import Refused
from middleware.entangled.quorum.ballot import Ballot, believed
from tests.middleware.consensus.lease.room import RoomCase, T


class CharterTests(RoomCase):
    def test_chain(self) -> None:
        """A charter contains the newest council, and survives encoding."""
        charter = self.chartered([3, 4, 6], [0, 4, 6])
        again = charter_of(charter.packed)
        self.assertEqual(again, charter)
        self.assertTrue(charter.is_genuine(T))
        self.assertEqual([self.room.place_of(member) for member in charter.members], [0, 4, 6])
        self.assertEqual((charter.configuration, charter.token, charter.ballot), (3, 7, Ballot(2, "agent")))

    def test_anything_changed(self) -> None:
        """A charter with a changed task, member, order, ballot, token or signer, or too few signers, is not genuine."""
        charter = self.chartered([3, 4, 6], [0, 4, 6])
        first, second = charter.links
        forged = self.room.identities[6]
        for links in (
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
            self.assertFalse(replace(charter, links=links).is_genuine(T), links)
        self.assertFalse(charter.is_genuine("t1"))
        self.assertFalse(replace(charter, owner=forged.public).is_genuine(T))
        self.assertFalse(replace(charter, first=tuple(self.room.contacts[:3])).is_genuine(T))

    def test_one_signer_is_no_majority(self) -> None:
        """A council needs the signatures of a majority, and has at least three members."""
        self.assertFalse(self.chartered([3, 4, 6], signers=1).is_genuine(T))
        self.assertFalse(self.chartered([3]).is_genuine(T))

    def test_judge(self) -> None:
        """A council pinned by a node without the right to publish tasks is rejected."""
        pinned = pin(self.room.identities[0], T, tuple(self.room.contacts[:3]))
        judge = self.room.judge
        self.assertIsNone(judge.read(T, pinned.packed))
        self.assertEqual(Judge(lambda public, task_id: True).read(T, pinned.packed), pinned)
        self.assertIsNone(judge.read(T, self.chartered([3, 4, 6], signers=1).packed))

    def test_bounded(self) -> None:
        """The number of links of a charter and its token are limited."""
        charter = self.chartered([3, 4, 6])
        full = replace(charter, links=charter.links * MAX_LINKS)
        self.assertRaises(Refused, full.extended, charter.members, charter.ballot, ())
        self.assertEqual(charter_of(full.packed), full)
        self.assertIsNone(charter_of(replace(charter, links=charter.links * (MAX_LINKS + 1)).packed))
        link = charter.links[0]._replace(votes=((0, 2**61, bytes(64)), (1, 3, bytes(64))))
        self.assertEqual(replace(charter, links=(link,)).token, MAX_TOKEN)

    def test_ending(self) -> None:
        """A majority of the current council proves the agent that ended the task, and its token."""
        pinned = self.room.councils[T]
        for charter, seats in ((pinned, [3, 4, 5]), (self.chartered([0, 4, 6]), [0, 4, 6])):
            votes = [
                (place, sign_end(self.room.identities[seat], T, charter.configuration, "a", 7))
                for place, seat in enumerate(seats)
            ]
            ending = ending_of(Ending(charter, tuple(votes[:2])).packed, pinned)
            assert ending is not None
            self.assertTrue(ending.is_genuine(T, "a", 7))
            self.assertFalse(ending.is_genuine(T, "a", 8))
            self.assertFalse(ending.is_genuine(T, "b", 7))
            self.assertFalse(ending.is_genuine("t1", "a", 7))
            self.assertFalse(replace(ending, signatures=(votes[0],)).is_genuine(T, "a", 7))
            self.assertFalse(replace(ending, signatures=(votes[0], votes[0])).is_genuine(T, "a", 7))
        other = pin(self.room.operator, T, tuple(self.room.contacts[:3]))
        self.assertIsNone(ending_of(Ending(self.chartered([0, 4, 6]), tuple(votes)).packed, other))

    @settings(max_examples=100)
    @given(st.recursive(st.none() | st.integers() | st.binary(max_size=70) | st.text(), st.lists, max_leaves=20))
    def test_anything_from_the_wire(self, content: object) -> None:
        """Any input is a charter or None, and never raises."""
        try:
            packed = bytes(msgpack.packb(content))
        except OverflowError:
            return
        self.assertIsInstance(charter_of(packed), Charter | None)
        self.assertIsInstance(ending_of(packed, self.chartered()), Ending | None)
        self.assertIsNone(self.room.judge.read(T, content))

    def test_signatures_are_apart(self) -> None:
        """A signature of a change is not valid for an end, and the reverse."""
        members = tuple(self.room.contacts[:3])
        identity = self.room.identities[3]
        self.assertNotEqual(sign_change(identity, T, 1, Ballot(7, "a"), members, 7), sign_end(identity, T, 1, "a", 7))


class NumberTests(RoomCase):
    def test_believed(self) -> None:
        """A high number that a single member of three reports does not count."""
        self.assertEqual(believed([5, 7, 3], 3), 7)
        self.assertEqual(believed([2**61, 7, 3], 3), 7)
        self.assertEqual(believed([2**61, 2**60], 3), 2**60)
        self.assertEqual(believed([2**61], 1), 2**61)
        self.assertEqual(believed([], 3), 0)
