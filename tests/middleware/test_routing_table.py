"""Tests of the routing table."""

from __future__ import annotations

import random

from hypothesis import given, settings
from hypothesis import strategies as st
from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.contact import Contact
from middleware.entangled.kademlia.distance import bucket_index, select_closest
from middleware.entangled.kademlia.routing_table import DROPPED_AFTER, PING_INTERVAL_S, STALE_AFTER, RoutingTable
from middleware.entangled.network.network import Address

OWN = Contact(b"\xee" * 32, Address("10.0.0.1", 7000))


def contact(number: int, port: int = 7000) -> Contact:
    return Contact(number.to_bytes(32), Address("10.0.0.2", port))


def of_bucket(index: int, count: int) -> list[Contact]:
    """Return the first ``count`` contacts of bucket ``index`` of ``OWN``."""
    found: list[Contact] = []
    number = 0
    while len(found) < count:
        number += 1
        if bucket_index(OWN.node_id, contact(number).node_id) == index:
            found.append(contact(number))
    return found


class RoutingTableTest(SynchronousTestCase):
    def setUp(self) -> None:
        self.table = RoutingTable(OWN.node_id, k=4)
        self.old = of_bucket(159, 12)
        self.new = self.old[4:]
        self.near = of_bucket(157, 4)

    def fill(self) -> None:
        """Fill a bucket with far contacts, and add k nearer contacts, which are the neighbours of the node."""
        for near in self.near:
            self.table.record_contact(near, 0.0)
        for moment, known in enumerate(self.old[:4]):
            self.assertIsNone(self.table.record_contact(known, float(moment)))

    def far(self) -> list[Contact]:
        """Return the far contacts in the table."""
        return [known for known in self.table.list_contacts() if known in self.old]

    def miss(self, missing: Contact, times: int) -> None:
        for _ in range(times):
            self.table.record_miss(missing, 100.0)

    def test_never_oneself(self) -> None:
        """A node is never a contact of itself."""
        self.assertIsNone(self.table.record_contact(OWN, 0.0))
        self.table.record_miss(OWN, 0.0)
        self.table.remove(OWN)
        self.table.record_lookup(OWN.node_id, 0.0)
        self.assertEqual((len(self.table), self.table.find_stale(1000.0, 60.0)), (0, []))
        self.assertIsNone(self.table.get(OWN.node_id))

    def test_address_moves(self) -> None:
        """A contact with a verified new address is listed once, at this address, and its failures are cleared."""
        self.table.record_contact(contact(1), 0.0)
        self.table.record_contact(contact(1, port=7001), 1.0)
        self.miss(contact(1), DROPPED_AFTER)
        self.assertEqual((len(self.table), self.table.list_contacts()), (1, [contact(1, port=7001)]))

    def test_full_bucket_keeps_the_old(self) -> None:
        """A new contact displaces no contact of a full bucket.

        The least recently heard contact is returned for a ping.
        """
        self.fill()
        self.assertEqual(self.table.record_contact(self.new[0], 10.0), self.old[0])
        self.assertEqual(self.far(), self.old[:4])
        self.assertIsNone(self.table.get(self.new[0].node_id))
        self.table.record_contact(self.old[1], 15.0)
        self.assertEqual(self.table.record_contact(self.new[0], 20.0), self.old[0])
        self.table.record_contact(self.old[0], 25.0)
        self.assertEqual(self.table.record_contact(self.new[0], 30.0), self.old[2])

    def test_no_flood_of_pings(self) -> None:
        """The old contact is returned for a ping once per ``PING_INTERVAL_S``, even if there are many new contacts."""
        self.fill()
        asked = [self.table.record_contact(newcomer, 10.0) for newcomer in self.new]
        self.assertEqual(asked, [self.old[0]] + [None] * 7)
        self.assertEqual(self.table.record_contact(self.new[0], 10.0 + PING_INTERVAL_S), self.old[0])

    def test_replaced_from_the_cache(self) -> None:
        """After ``STALE_AFTER`` consecutive failures of a contact, the most recent waiting contact replaces it."""
        self.fill()
        for newcomer in self.new[:2]:
            self.table.record_contact(newcomer, 10.0)
        self.miss(self.old[1], STALE_AFTER - 1)
        self.assertIn(self.old[1], self.table.list_contacts())
        self.miss(self.old[1], 1)
        self.assertEqual(self.far(), [self.old[0], self.old[2], self.old[3], self.new[1]])
        self.assertEqual(len(self.table), 8)

    def test_cache_is_bounded(self) -> None:
        """At most k contacts wait in the cache; the least recently heard contact leaves the cache first."""
        self.fill()
        for newcomer in self.new:
            self.table.record_contact(newcomer, 10.0)
        for known in self.old[:4]:
            self.miss(known, STALE_AFTER)
        self.assertEqual(sorted(self.far(), key=self.old.index), self.new[4:])

    def test_silent_newcomer_leaves_the_cache(self) -> None:
        """A waiting contact that fails is removed from the cache."""
        self.fill()
        self.table.record_contact(self.new[0], 10.0)
        self.table.record_miss(self.new[0], 11.0)
        self.miss(self.old[0], STALE_AFTER)
        self.assertIn(self.old[0], self.table.list_contacts())

    def test_stale_gives_way_at_once(self) -> None:
        """A stale contact stays until a new contact needs its place."""
        self.fill()
        self.miss(self.old[2], STALE_AFTER)
        self.assertIn(self.old[2], self.table.list_contacts())
        self.assertIsNone(self.table.record_contact(self.new[0], 10.0))
        self.assertEqual(self.far(), [self.old[0], self.old[1], self.old[3], self.new[0]])
        self.assertEqual(len(self.table), 8)

    def test_dropped_after_five(self) -> None:
        """A contact is dropped after five consecutive failures; a message from the contact resets the count."""
        for moment in (0.0, 200.0):
            self.table.record_contact(contact(1), moment)
            self.miss(contact(1), DROPPED_AFTER - 1)
        self.miss(contact(2), DROPPED_AFTER)
        self.assertEqual(self.table.list_contacts(), [contact(1)])
        self.miss(contact(1), 1)
        self.assertEqual(self.table.list_contacts(), [])
        self.assertEqual(len(self.table), 0)

    def test_goodbye(self) -> None:
        """A contact that says goodbye is removed at once, and a waiting contact replaces it."""
        self.fill()
        self.table.record_contact(self.new[0], 10.0)
        self.table.record_contact(self.new[1], 10.0)
        self.table.remove(self.new[1])
        self.table.remove(self.old[0])
        self.assertEqual(self.far(), [*self.old[1:4], self.new[0]])
        self.assertEqual(len(self.table), 8)
        self.table.remove(contact(999_999))

    def test_closest_passes_over_the_stale(self) -> None:
        """``closest`` returns stale contacts only if there are too few others, then in the order of distance."""
        for known in self.old[:4]:
            self.table.record_contact(known, 0.0)
        nearest = select_closest(self.old[:4], self.old[0].node_id, 4)
        self.assertEqual(self.table.closest(self.old[0].node_id, 2), nearest[:2])
        self.miss(self.old[0], STALE_AFTER)
        self.assertEqual(self.table.closest(self.old[0].node_id, 3), nearest[1:])
        self.assertEqual(self.table.closest(self.old[0].node_id), nearest)

    def test_the_neighbourhood_is_known_whole(self) -> None:
        """The k contacts closest to the node are always in the table and listed first."""
        for moment, known in enumerate([*self.old[:4], *self.near]):
            self.table.record_contact(known, float(moment))
        self.assertEqual(self.table.list_contacts(), [*self.near, *self.old[:4]])
        self.setUp()

        crowd = of_bucket(158, 40)
        for moment, known in enumerate(crowd):
            self.table.record_contact(known, float(moment))
        nearest = select_closest(crowd, OWN.node_id, 4)
        self.assertLessEqual(set(nearest), set(self.table.list_contacts()))
        self.assertLess(len(self.table), 40)

    def test_buckets_to_refresh(self) -> None:
        """``stale_buckets`` returns buckets without a recent lookup, also empty buckets beyond the nearest contact."""
        self.table.record_contact(of_bucket(156, 1)[0], 0.0)
        self.table.record_contact(self.old[0], 50.0)
        self.assertEqual(self.table.find_stale(60.0, 60.0), [156, 157, 158])
        rng = random.Random(1)
        for index in (156, 157):
            self.table.record_lookup(self.table.refresh_target(index, rng), 60.0)
        self.assertEqual(self.table.find_stale(60.0, 60.0), [158])

    @given(st.integers(0, 159), st.integers())
    def test_refresh_target_lies_in_its_bucket(self, index: int, seed: int) -> None:
        """The lookup target for a bucket is in this bucket, and is determined by the seed."""
        table = RoutingTable(OWN.node_id)
        target = table.refresh_target(index, random.Random(seed))
        self.assertEqual(bucket_index(OWN.node_id, target), index)
        self.assertEqual(target, table.refresh_target(index, random.Random(seed)))

    @settings(max_examples=50)
    @given(
        st.lists(
            st.tuples(st.sampled_from(["record_contact", "record_miss", "remove"]), st.integers(0, 40)), max_size=200
        )
    )
    def test_invariants(self, events: list[tuple[str, int]]) -> None:
        """In every state each bucket has at most k contacts, each contact occurs once, and the length is correct."""
        table = RoutingTable(OWN.node_id, k=3)
        for moment, (event, number) in enumerate(events):
            getattr(table, event)(contact(number), float(moment))
            contacts = table.list_contacts()
            self.assertEqual(len(table), len(contacts))
            self.assertEqual(len({c.node_id for c in contacts}), len(contacts))
            self.assertTrue(all(len(bucket.entries) <= 3 for bucket in table._buckets))
            self.assertEqual([b.low for b in table._buckets[1:]], [b.high for b in table._buckets[:-1]])
            self.assertTrue(all(table.get(c.node_id) == c for c in contacts))
