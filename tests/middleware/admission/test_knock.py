"""Tests of what a newcomer and a bootstrap node say."""

from __future__ import annotations

import contextlib
import random

import msgpack
from hypothesis import given, settings
from hypothesis import strategies as st
from nacl import bindings
from twisted.trial.unittest import SynchronousTestCase

from middleware.admission import knock
from middleware.admission.certificate import ROOM, is_proof
from middleware.admission.knock import Welcome
from middleware.entangled.errors import Forged, Malformed
from middleware.entangled.kademlia.contact import Contact
from middleware.entangled.network.network import Address
from tests.middleware.admission.paper import identity, invited, operator

OPERATOR = operator()
CODE, _, INVITE = invited(OPERATOR)
DOG = identity("dog").public
SECRET = bytes(range(32))
EPHEMERAL = bindings.crypto_scalarmult_base(SECRET)
CONTACTS = tuple(Contact(identity(str(n)).public, Address("2001:db8::" + "1234:" * 3 + str(n), 7000)) for n in range(8))
WELCOME = Welcome(OPERATOR.public, "yard", b"p" * ROOM, ((2, b"s" * 32, 9), (1, b"t" * 32, 0)), CONTACTS, {"lan": True})


def knocked(wish: str = "dog") -> bytes:
    """A lawful KNOCK."""
    return knock.knock(CODE.key, DOG, EPHEMERAL, wish, random.Random(1))


class KnockTests(SynchronousTestCase):
    """Both datagrams."""

    def test_knock_is_read_as_it_was_said(self) -> None:
        """A bootstrap node that knows the invitation reads the newcomer's key, wish and proof."""
        said = knocked()
        found = knock.opened_knock(said, INVITE.public)
        self.assertEqual((found.public, found.ephemeral, found.wish), (DOG, EPHEMERAL, "dog"))
        self.assertTrue(is_proof(INVITE.public, DOG, "dog", found.proof))
        self.assertFalse(is_proof(INVITE.public, DOG, "cat", found.proof))

    def test_knock_hides_who_comes(self) -> None:
        """Who reads the wire sees neither key nor name; all knocks are as long as a datagram may be."""
        said = knocked()
        self.assertNotIn(DOG, said)
        self.assertEqual({len(knocked(name)) for name in ("", "dog", "n" * 40)}, {1400})

    def test_welcome_is_read_as_it_was_given(self) -> None:
        """The newcomer reads what it is given; the fullest welcome loses contacts rather than outgrow its knock."""
        given = knock.welcome(INVITE.public, EPHEMERAL, WELCOME, random.Random(2))
        self.assertLessEqual(len(given), knock.KNOCK_BYTES)
        found = knock.opened_welcome(given, CODE.key.public, SECRET)
        assert isinstance(found, Welcome)
        self.assertEqual((found.shown, found.secrets, found.settings), (b"p" * ROOM, WELCOME.secrets, {"lan": True}))
        self.assertEqual(found.contacts, CONTACTS[: len(found.contacts)])
        self.assertGreater(len(found.contacts), 3)

    def test_welcome_is_for_one(self) -> None:
        """Another ephemeral key, or another code, opens nothing."""
        given = knock.welcome(INVITE.public, EPHEMERAL, WELCOME, random.Random(2))
        other = invited(OPERATOR, seed=2)[2].public
        self.assertRaises(Forged, knock.opened_welcome, given, INVITE.public, b"x" * 32)
        self.assertRaises(Forged, knock.opened_welcome, given, other, SECRET)

    def test_refusals_have_names(self) -> None:
        """A refusal comes through by its code; one that nobody knows, and the hint of a stranger, mean unknown."""
        for code, read in (("used", "used"), ("silly", "unknown")):
            said = knock.refusal(INVITE.public, EPHEMERAL, code, random.Random(2))
            self.assertEqual(knock.opened_welcome(said, INVITE.public, SECRET), read)
        hint = knock.unknown(knock.id_of(knocked()))
        self.assertEqual((knock.opened_welcome(hint, INVITE.public, SECRET), len(hint)), ("unknown", 9))

    @given(st.integers(0, 1399), st.integers(1, 255), st.binary(max_size=1400))
    @settings(max_examples=200, deadline=None)
    def test_reads_anything(self, place: int, change: int, junk: bytes) -> None:
        """Whatever comes is refused as forged or malformed: junk, and each datagram with one byte changed."""
        said = bytearray(knocked())
        said[place] ^= change
        self.assertRaises((Forged, Malformed), knock.opened_knock, bytes(said), INVITE.public)
        self.assertRaises((Forged, Malformed), knock.opened_knock, b"\x17" + junk, INVITE.public)
        given = bytearray(knock.welcome(INVITE.public, EPHEMERAL, WELCOME, random.Random(2)))
        given[1 + place % (len(given) - 1)] ^= change
        self.assertRaises((Forged, Malformed), knock.opened_welcome, bytes(given), INVITE.public, SECRET)

    @given(st.recursive(st.integers(0, 99) | st.binary(max_size=70) | st.text(max_size=5), st.lists, max_leaves=20))
    @settings(max_examples=200, deadline=None)
    def test_who_has_the_code_may_seal_anything(self, body: object) -> None:
        """A welcome that opens and holds something else raises nothing but Malformed, or is a refusal."""
        said = knock._answered(INVITE.public, EPHEMERAL, msgpack.packb(body), random.Random(2))
        with contextlib.suppress(Malformed):
            self.assertIsInstance(knock.opened_welcome(said, INVITE.public, SECRET), str)
