"""Tests of the prefixes of the directory: their keys, the prefixes of a device, and the duration of its lease."""

from __future__ import annotations

import random

from twisted.trial.unittest import SynchronousTestCase

from middleware.directory.prefix import (
    MAX_LEASE_S,
    MAX_UNDIVIDED,
    MIN_DEVICES_PER_PLACE,
    ROOT,
    ROOT_LISTED_DEPTH,
    UNDIVIDED_AGAIN,
    choose_depth,
    compute_lease,
    compute_places,
    compute_prefix,
    estimate_size,
)
from middleware.directory.presence import DEVICES, MAX_DEPTH
from middleware.entangled.contact import Contact
from middleware.entangled.identity import ID_BYTES
from middleware.entangled.network.network import Address


def ids(count: int, seed: int = 1) -> list[bytes]:
    dice = random.Random(seed)
    return [dice.randbytes(ID_BYTES) for _ in range(count)]


class PrefixTests(SynchronousTestCase):
    def test_depth_zero_is_the_old_key(self) -> None:
        """At depth 0 every device is under the root key, which is the only key of a small team."""
        self.assertEqual(ROOT.key, DEVICES)
        for node_id in ids(20):
            self.assertEqual(compute_places(node_id, 0), [DEVICES])

    def test_a_key_begins_as_its_devices_do(self) -> None:
        """The key of a prefix starts with the same bits as its devices' ids, so the key is near their nodes."""
        for node_id in ids(20):
            for depth in range(MAX_DEPTH + 1):
                place = compute_prefix(node_id, depth)
                self.assertTrue(place.has(node_id) and place.has(place.key))
                self.assertTrue(place.has(place.first) and place.first <= node_id)

    def test_halves(self) -> None:
        """When a prefix is split, one half keeps the key of the prefix, and the other half has a new key.

        Each id is in exactly one half.
        """
        for node_id in ids(20):
            place = compute_prefix(node_id, 5)
            self.assertEqual(place.same_key_half.key, place.key)
            self.assertNotEqual(place.other_key_half.key, place.key)
            self.assertNotEqual(place.same_key_half.has(node_id), place.other_key_half.has(node_id))

    def test_two_places_and_one_stays(self) -> None:
        """A device whose depth changes by one keeps one of its keys."""
        for node_id in ids(50):
            for depth in range(MAX_DEPTH):
                before, after = compute_places(node_id, depth), compute_places(node_id, depth + 1)
                self.assertTrue(set(before) & set(after))
                self.assertLessEqual(len(after), 3 if depth < ROOT_LISTED_DEPTH else 2)

    def test_small_team_is_never_split(self) -> None:
        """The depth is 0 for up to ``MAX_UNDIVIDED`` members, and is 0 again only at ``UNDIVIDED_AGAIN`` members."""
        self.assertEqual([choose_depth(size, 0) for size in (1, 8, 48, MAX_UNDIVIDED)], [0] * 4)
        self.assertEqual([choose_depth(size) for size in (1, 8, 48, MAX_UNDIVIDED)], [0] * 4)
        self.assertEqual(choose_depth(MAX_UNDIVIDED + 1, 0), 1)
        self.assertEqual(choose_depth(UNDIVIDED_AGAIN + 1, 1), 1)
        self.assertEqual(choose_depth(UNDIVIDED_AGAIN, 1), 0)

    def test_hysteresis(self) -> None:
        """From any depth a device reaches the right depth; small changes of the team size do not change the depth."""
        for exponent in range(1, MAX_DEPTH):
            size = MIN_DEVICES_PER_PLACE * 2.0**exponent * 1.4
            if size <= MAX_UNDIVIDED:
                continue
            for depth in (0, 3, MAX_DEPTH):
                for _ in range(2 * MAX_DEPTH):
                    depth = choose_depth(size, depth)
                self.assertLessEqual(abs(depth - exponent), 1)
                self.assertEqual(choose_depth(size * 1.1, depth), depth)
                self.assertEqual(choose_depth(size / 1.1, depth), depth)
        border = MIN_DEVICES_PER_PLACE * 2.0**6
        self.assertEqual([choose_depth(border * 1.05, 5), choose_depth(border / 1.05, 6)], [5, 6])
        # A device changes its depth by at most one at a time, and never exceeds the maximum.
        self.assertEqual([choose_depth(1e9, 0), choose_depth(3, 9), choose_depth(1, 0)], [1, 8, 0])
        self.assertEqual([choose_depth(1e30, MAX_DEPTH), choose_depth(1e30)], [MAX_DEPTH, MAX_DEPTH])

    def test_lease_grows_with_the_depth(self) -> None:
        """A team with one prefix uses the normal lease; each depth doubles the lease, up to a minute."""
        self.assertEqual([compute_lease(depth, 1.0) for depth in (0, 1, 2, 5)], [1.0, 2.0, 4.0, 32.0])
        self.assertEqual(compute_lease(MAX_DEPTH, 1.0), MAX_LEASE_S)
        self.assertEqual([compute_lease(0, 90.0), compute_lease(4, 90.0)], [90.0, 90.0])

    def test_size(self) -> None:
        """If there are few contacts, they are counted.

        In a large team the nearest contacts give the size within a factor of two.
        """
        contacts = [Contact(random.Random(n).randbytes(32), Address("10.0.0.1", 7000)) for n in range(3000)]
        self.assertEqual(estimate_size(contacts[0].node_id, contacts[1:7]), 7)
        right = 0
        for contact in contacts[:100]:
            near = sorted(contacts, key=lambda c: int.from_bytes(c.node_id) ^ int.from_bytes(contact.node_id))[1:9]
            right += 1500 < estimate_size(contact.node_id, near) < 6000
        self.assertGreaterEqual(right, 90)
