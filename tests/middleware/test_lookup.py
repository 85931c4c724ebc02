"""Tests of the iterative lookup and of the XOR metric."""

from __future__ import annotations

import random

from hypothesis import given, settings
from hypothesis import strategies as st
from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.contact import Contact
from middleware.entangled.identity import ID_BYTES
from middleware.entangled.kademlia.distance import bucket_index, distance, select_closest
from middleware.entangled.kademlia.lookup import Lookup
from middleware.entangled.kademlia.routing_table import RoutingTable
from middleware.entangled.network.network import Address

TARGET = b"\x55" * 20


def contact(number: int) -> Contact:
    return Contact(number.to_bytes(32), Address("10.0.0.1", 7000 + number))


CROWD = select_closest([contact(i) for i in range(40)], TARGET, 40)


class LookupTest(SynchronousTestCase):
    def test_asks_the_closest_first(self) -> None:
        """At most alpha contacts are queried at the same time, the closest first, and each only once."""
        lookup = Lookup(TARGET, 8, 3, reversed(CROWD[:8]))
        self.assertEqual(lookup.take_next(), CROWD[:3])
        self.assertEqual(lookup.take_next(), [])
        lookup.record_answer(CROWD[1], [])
        self.assertEqual(lookup.take_next(), [CROWD[3]])
        self.assertFalse(lookup.is_finished)

    def test_follows_what_it_hears(self) -> None:
        """Closer contacts from a reply are queried before the contacts that were known earlier."""
        lookup = Lookup(TARGET, 2, 1, CROWD[10:12])
        lookup.take_next()
        lookup.record_answer(CROWD[10], [CROWD[0], CROWD[5], CROWD[10]])
        self.assertEqual(lookup.take_next(), [CROWD[0]])

    def test_ends_when_the_k_closest_answered(self) -> None:
        """The lookup ends when the k closest contacts have replied; farther ones are not queried."""
        lookup = Lookup(TARGET, 2, 3, CROWD[:5])
        self.assertEqual(lookup.take_next(), CROWD[:2])
        lookup.record_answer(CROWD[0], CROWD)
        self.assertFalse(lookup.is_finished)
        lookup.record_answer(CROWD[1], CROWD)
        self.assertTrue(lookup.is_finished)
        self.assertEqual(lookup.take_next(), [])
        self.assertEqual(lookup.closest(), CROWD[:2])

    def test_failed_is_replaced(self) -> None:
        """The next closest contact replaces a failed contact, which is not in the result."""
        lookup = Lookup(TARGET, 2, 3, CROWD[:3])
        lookup.take_next()
        lookup.record_failure(CROWD[0])
        self.assertEqual(lookup.take_next(), [CROWD[2]])
        for known in CROWD[1:3]:
            lookup.record_answer(known, [CROWD[0]])
        self.assertEqual(lookup.take_next(), [])
        self.assertTrue(lookup.is_finished)
        self.assertEqual(lookup.closest(), CROWD[1:3])

    def test_all_fail(self) -> None:
        """A lookup without contacts, or with only failed contacts, ends with an empty result."""
        for seeds in ([], CROWD[:2]):
            lookup = Lookup(TARGET, 8, 3, seeds)
            for known in lookup.take_next():
                lookup.record_failure(known)
            self.assertTrue(lookup.is_finished)
            self.assertEqual((lookup.take_next(), lookup.closest()), ([], []))

    def test_slow_frees_its_place(self) -> None:
        """While a contact is slow to reply, the lookup queries further contacts.

        The lookup still waits for this contact, and replaces it if it fails.
        """
        for is_lost in (False, True):
            lookup = Lookup(TARGET, 2, 2, CROWD[:4])
            self.assertEqual(lookup.take_next(), CROWD[:2])
            lookup.mark_slow(CROWD[0])
            lookup.mark_slow(CROWD[0])
            self.assertEqual(lookup.take_next(), [CROWD[2]])
            lookup.record_answer(CROWD[1], [])
            lookup.record_answer(CROWD[2], [])
            self.assertFalse(lookup.is_finished)
            if is_lost:
                lookup.record_failure(CROWD[0])
            else:
                lookup.record_answer(CROWD[0], [])
            self.assertTrue(lookup.is_finished)
            self.assertEqual(lookup.closest(), CROWD[1:3] if is_lost else CROWD[:2])

    def test_late_answer_counts(self) -> None:
        """A reply is accepted from a contact that already counted as failed."""
        lookup = Lookup(TARGET, 2, 2, CROWD[:1])
        lookup.take_next()
        lookup.record_failure(CROWD[0])
        lookup.record_answer(CROWD[0], [CROWD[1]])
        self.assertEqual(lookup.closest(), [CROWD[0]])
        self.assertEqual(lookup.take_next(), [CROWD[1]])

    def test_never_oneself(self) -> None:
        """The searching node is neither queried nor in the result."""
        lookup = Lookup(TARGET, 8, 3, CROWD[:2], exclude=CROWD[0].node_id)
        self.assertEqual(lookup.take_next(), [CROWD[1]])
        lookup.record_answer(CROWD[1], CROWD[:1])
        self.assertEqual(lookup.take_next(), [])
        self.assertTrue(lookup.is_finished)

    def test_strangers_do_not_count(self) -> None:
        """Replies and failures of contacts that were not queried are ignored."""
        lookup = Lookup(TARGET, 8, 3, CROWD[:4])
        for stranger in (CROWD[0], CROWD[9]):
            lookup.record_answer(stranger, CROWD[4:])
            lookup.record_failure(stranger)
            lookup.mark_slow(stranger)
        self.assertEqual(lookup.take_next(), CROWD[:3])
        self.assertEqual(lookup.closest(), [])

    def test_an_answer_is_bounded(self) -> None:
        """At most the k closest contacts of one reply are used."""
        lookup = Lookup(TARGET, 2, 40, CROWD[39:])
        lookup.take_next()
        lookup.record_answer(CROWD[39], CROWD[:39])
        asked = lookup.take_next()
        for known in asked:
            lookup.record_failure(known)
        self.assertEqual(asked, CROWD[:2])
        self.assertEqual(lookup.take_next(), [])

    @settings(max_examples=30)
    @given(st.integers(0, 2**32), st.integers(2, 60), st.binary(min_size=20, max_size=20))
    def test_exact(self, seed: int, size: int, target: bytes) -> None:
        """In a network without loss and with complete tables the lookup finds exactly the k closest nodes."""
        rng = random.Random(seed)
        nodes = [contact(i) for i in range(size)]
        tables = {node.node_id: RoutingTable(node.node_id, 4) for node in nodes}
        for table in tables.values():
            for node in rng.sample(nodes, size):
                table.record_contact(node, 0.0)
        me = nodes[0]
        lookup = Lookup(target, 4, 3, tables[me.node_id].closest(target), exclude=me.node_id)
        in_flight: list[Contact] = []
        while not lookup.is_finished:
            in_flight += lookup.take_next()
            self.assertLessEqual(len(in_flight), 3)
            asked = in_flight.pop(rng.randrange(len(in_flight)))
            lookup.record_answer(asked, tables[asked.node_id].closest(target))
        self.assertEqual(lookup.closest(), select_closest(nodes[1:], target, 4))


IDS = st.binary(min_size=ID_BYTES, max_size=ID_BYTES)


class DistanceTest(SynchronousTestCase):
    @given(IDS, IDS, IDS)
    def test_metric(self, a: bytes, b: bytes, c: bytes) -> None:
        """The distance is a metric: it is zero only for equal ids, symmetric, and satisfies the triangle inequality."""
        self.assertEqual(distance(a, b) == 0, a == b)
        self.assertEqual(distance(a, b), distance(b, a))
        self.assertLessEqual(distance(a, c), distance(a, b) + distance(b, c))

    @given(IDS, IDS)
    def test_bucket_holds_its_range(self, own: bytes, other: bytes) -> None:
        """Bucket i of an id covers the distances from 2**i to below 2**(i+1)."""
        if own != other:
            index = bucket_index(own, other)
            self.assertLessEqual(2**index, distance(own, other))
            self.assertLess(distance(own, other), 2 ** (index + 1))

    def test_no_bucket_for_oneself(self) -> None:
        """No bucket contains the node's own id."""
        self.assertRaises(ValueError, bucket_index, b"\1" * ID_BYTES, b"\1" * ID_BYTES)

    def test_closest_first(self) -> None:
        """``closest`` returns at most the requested number of contacts, closest first, whatever the input order."""
        contacts = [contact(i) for i in range(30)]
        target = contacts[7].node_id
        found = select_closest(contacts, target, 5)
        self.assertEqual(found, select_closest(reversed(contacts), target, 5))
        self.assertEqual(found[0], contacts[7])
        self.assertEqual(len(select_closest(contacts, target, 99)), 30)
        ranked = sorted(distance(c.node_id, target) for c in contacts)

        self.assertEqual([distance(c.node_id, target) for c in found], ranked[:5])
