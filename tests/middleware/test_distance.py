"""The XOR metric of ids."""

from __future__ import annotations

from hypothesis import given, settings
from hypothesis import strategies as st
from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.contact import Contact
from middleware.entangled.identity import ID_BYTES
from middleware.entangled.kademlia.distance import bucket_index, closest, distance
from middleware.entangled.network.network import Address

IDS = st.binary(min_size=ID_BYTES, max_size=ID_BYTES)


def contact(number: int, port: int = 7000) -> Contact:
    return Contact(number.to_bytes(32), Address("10.0.0.1", port))


class DistanceTest(SynchronousTestCase):
    @settings(deadline=None, derandomize=True, database=None)
    @given(IDS, IDS, IDS)
    def test_metric(self, a: bytes, b: bytes, c: bytes) -> None:
        """The distance is a metric: zero for one id only, the same both ways, and no way round is shorter."""
        self.assertEqual(distance(a, b) == 0, a == b)
        self.assertEqual(distance(a, b), distance(b, a))
        self.assertLessEqual(distance(a, c), distance(a, b) + distance(b, c))

    @settings(deadline=None, derandomize=True, database=None)
    @given(IDS, IDS)
    def test_bucket_holds_its_range(self, own: bytes, other: bytes) -> None:
        """The bucket i of an id spans the distances from 2**i to below 2**(i+1)."""
        if own != other:
            index = bucket_index(own, other)
            self.assertLessEqual(2**index, distance(own, other))
            self.assertLess(distance(own, other), 2 ** (index + 1))

    def test_no_bucket_for_oneself(self) -> None:
        """A node's own id has no bucket."""
        self.assertRaises(ValueError, bucket_index, b"\1" * ID_BYTES, b"\1" * ID_BYTES)

    def test_closest_first(self) -> None:
        """The closest contacts come first, whatever the order they were given in, and no more than asked for."""
        contacts = [contact(i) for i in range(30)]
        target = contacts[7].node_id
        found = closest(contacts, target, 5)
        self.assertEqual(found, closest(reversed(contacts), target, 5))
        self.assertEqual(found[0], contacts[7])
        self.assertEqual(len(closest(contacts, target, 99)), 30)
        ranked = sorted(distance(c.node_id, target) for c in contacts)

        self.assertEqual([distance(c.node_id, target) for c in found], ranked[:5])
