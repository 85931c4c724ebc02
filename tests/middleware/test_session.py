"""Tests of the encryption and the replay window of sessions."""

from __future__ import annotations

import random

from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.contact import Contact
from middleware.entangled.errors import Forged
from middleware.entangled.identity import Identity
from middleware.entangled.network.network import MAX_DATAGRAM_BYTES, Address
from middleware.entangled.wire.noise import TransportKeys
from middleware.entangled.wire.session import MAX_PLAIN_BYTES, OVERHEAD_BYTES, WINDOW, Session, read_index


class SessionTests(SynchronousTestCase):
    """Tests of ``Session``."""

    def setUp(self) -> None:
        """Create the two ends of one session."""
        contact = Contact(Identity(bytes(32)).public, Address("127.0.0.1", 1))
        one, two = b"1" * 32, b"2" * 32
        self.a = Session(contact, 7, 8, TransportKeys(one, two, b""), 0.0, True)
        self.b = Session(contact, 8, 7, TransportKeys(two, one, b""), 0.0, True)

    def test_carries_messages_both_ways(self) -> None:
        """Each end decrypts the other's messages, even the largest; the overhead is at most 36 bytes."""
        datagram = self.a.seal(b"hello")
        self.assertEqual(self.b.open(datagram), (b"hello", 1))
        self.assertEqual(self.a.open(self.b.seal(b"")), (b"", 1))
        self.assertEqual((read_index(datagram), len(datagram) - 5), (8, OVERHEAD_BYTES))
        self.assertLessEqual(OVERHEAD_BYTES, 36)
        self.assertEqual(len(self.a.seal(bytes(MAX_PLAIN_BYTES))), MAX_DATAGRAM_BYTES)

    def test_opens_each_once_in_any_order(self) -> None:
        """Each datagram within the replay window is accepted exactly once, in any order."""
        datagrams = [self.a.seal(b"%d" % number) for number in range(WINDOW)]
        shuffled = datagrams[:]
        random.Random(1).shuffle(shuffled)
        self.assertEqual({self.b.open(datagram)[0] for datagram in shuffled}, {b"%d" % n for n in range(WINDOW)})
        for datagram in datagrams:
            self.assertTrue(self.b.is_replay(datagram))
            self.assertRaises(Forged, self.b.open, datagram)

    def test_refuses_what_fell_out_of_the_window(self) -> None:
        """A datagram older than the replay window is rejected; the oldest datagram in the window is accepted."""
        datagrams = [self.a.seal(b"") for _ in range(WINDOW + 1)]
        self.b.open(datagrams[-1])
        self.assertTrue(self.b.is_replay(datagrams[0]))
        self.assertEqual(self.b.open(datagrams[1]), (b"", 1 - WINDOW))

    def test_window_survives_a_leap(self) -> None:
        """After a gap larger than the window, older datagrams are rejected and later datagrams are accepted."""
        early = self.a.seal(b"early")
        self.b.open(self.a.seal(b""))
        self.a._sent = 2**40
        late = self.a.seal(b"late")
        self.assertEqual(self.b.open(late), (b"late", 2**40 - 1))
        self.assertRaises(Forged, self.b.open, early)
        self.assertRaises(Forged, self.b.open, late)
        self.assertEqual(self.b.open(self.a.seal(b"next"))[0], b"next")

    def test_forged_datagram_changes_nothing(self) -> None:
        """A datagram with a flipped byte is rejected, and the original datagram is accepted after that."""
        datagram = self.a.seal(b"hello")
        for place in range(5, len(datagram)):
            damaged = bytearray(datagram)
            damaged[place] ^= 0x80
            self.assertRaises(Forged, self.b.open, bytes(damaged))
        self.assertRaises(Forged, self.b.open, datagram[: OVERHEAD_BYTES - 1])
        self.assertEqual(self.b.open(datagram), (b"hello", 1))
