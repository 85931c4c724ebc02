"""Tests of the member table, which counts the members for a majority."""

from __future__ import annotations

from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.contact import Contact
from middleware.entangled.identity import Identity
from middleware.entangled.kademlia.distance import select_closest
from middleware.entangled.kademlia.member_table import ABSENT_WITH_MAJORITY_S, MAX_ABSENT_S, MAX_MEMBERS, MemberTable
from middleware.entangled.network.network import Address

ME = Contact(Identity(bytes(32)).public, Address("10.0.0.1", 1))


def contact(number: int) -> Contact:
    """Return a contact with this number."""
    return Contact(number.to_bytes(32), Address("10.0.0.1", number))


class MemberTableTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.members = MemberTable(ME.node_id)

    def fill(self, count: int) -> None:
        for number in range(1, 1 + count):
            self.assertTrue(self.members.mark_alive(contact(number), 0.0))

    def test_closest_with_oneself(self) -> None:
        """The closest members include the node itself and are sorted by distance."""
        self.fill(6)
        everybody = [ME, *map(contact, range(1, 7))]
        for key in (ME.node_id, contact(3).node_id):
            self.assertEqual(self.members.closest(key, 4, ME), select_closest(everybody, key, 4))

    def test_coming_and_going(self) -> None:
        """A lost member is absent until it is heard, and a member that left is removed.

        The digest of the table changes with its members.
        """
        self.fill(3)
        before = self.members.digest()
        self.assertTrue(self.members.mark_absent(contact(2).node_id, 1.0))
        self.assertFalse(self.members.mark_absent(contact(2).node_id, 1.0))
        self.assertEqual(self.members.list_absent(), [contact(2)])
        self.assertNotEqual(self.members.digest(), before)
        self.assertTrue(self.members.mark_alive(contact(2), 2.0))
        self.assertFalse(self.members.mark_alive(contact(2), 3.0))
        self.assertEqual(self.members.digest(), before)
        self.members.remove(contact(2).node_id)
        self.assertEqual((len(self.members), self.members.list_absent()), (2, []))

    def test_a_majority_strikes_soon(self) -> None:
        """A node in touch with a majority removes absent members early, other nodes only after ``MAX_ABSENT_S``."""
        for lost, wait in ((2, ABSENT_WITH_MAJORITY_S), (3, MAX_ABSENT_S)):
            self.members = MemberTable(ME.node_id)
            self.fill(4)
            for number in range(1, 1 + lost):
                self.members.mark_absent(contact(number).node_id, 10.0)
            self.assertEqual(self.members.remove_expired(10.0 + wait), [])
            self.assertEqual(len(self.members.remove_expired(10.1 + wait)), lost)
            self.assertEqual(self.members.list_absent(), [])

    def test_in_touch(self) -> None:
        """A node is in touch if it recently heard a majority of all members, including absent members."""
        self.assertTrue(self.members.is_majority_alive(0.0, 10.0))
        self.fill(4)
        self.assertTrue(self.members.is_majority_alive(10.0, 10.0))
        self.assertFalse(self.members.is_majority_alive(11.0, 10.0))
        for number in (1, 2):
            self.members.mark_alive(contact(number), 11.0)
        self.assertTrue(self.members.is_majority_alive(11.0, 10.0))

    def test_full(self) -> None:
        """A full member table accepts a new member only if it can remove an absent member."""
        self.fill(MAX_MEMBERS)
        self.assertTrue(self.members.is_full)
        self.assertFalse(self.members.mark_alive(contact(1000), 0.0))
        self.members.mark_absent(contact(1).node_id, 0.0)
        self.assertTrue(self.members.mark_alive(contact(1000), 0.0))
        self.assertEqual(self.members.list_absent(), [])

    def test_remembered(self) -> None:
        """A member restored from an earlier run counts as absent until it is heard."""
        self.members.add_absent(contact(1), 0.0)
        self.assertEqual((len(self.members), self.members.list_absent()), (0, [contact(1)]))
        self.assertFalse(self.members.is_majority_alive(0.0, 10.0))
