"""Tests of the messages between a newcomer and a bootstrap node."""

from __future__ import annotations

import contextlib
import random
from dataclasses import replace

import msgpack
from hypothesis import given, settings
from hypothesis import strategies as st
from nacl import bindings
from twisted.trial.unittest import SynchronousTestCase

from middleware.admission import join_codec
from middleware.admission.certificate import MAX_CERTIFICATE_BYTES, is_join_signature
from middleware.admission.join_code import JoinCode, TermsContent, seal_terms
from middleware.admission.join_codec import JoinReply, Signer, UnsignedRefusal, VerifiedReply
from middleware.entangled.contact import Contact
from middleware.entangled.errors import Forged, Malformed
from middleware.entangled.network.network import Address
from tests.middleware.admission.paper import granted, identity, invited, operator

OPERATOR = operator()
CODE, _, INVITE = invited(OPERATOR)
DOG = identity("dog").public
SECRET = bytes(range(32))
EPHEMERAL = bindings.crypto_scalarmult_base(SECRET)
CONTACTS = tuple(Contact(identity(str(n)).public, Address("2001:db8::" + "1234:" * 3 + str(n), 7000)) for n in range(8))
JOIN_REPLY = JoinReply(b"p" * MAX_CERTIFICATE_BYTES, ((2, b"s" * 32, 9), (1, b"t" * 32, 0)), CONTACTS)
CONTENT = TermsContent(OPERATOR.public, "yard", {"lan": True})
HEARD = join_codec.JoinRequest(DOG, EPHEMERAL, "dog", b"")


def signer(name: str = "vaio", role: str = "bootstrap", code: JoinCode = CODE) -> Signer:
    """Return a signer that replies as the node ``name``, with the terms of ``code``."""
    return Signer(identity(name), granted(OPERATOR, name, role), seal_terms(code, CONTENT, random.Random(3)))


def welcomed(by: Signer | None = None) -> bytes:
    """Return a join reply (JOIN_REPLY) signed by ``by``, or by default by the valid signer."""
    return join_codec.make_reply(INVITE.public, HEARD, JOIN_REPLY, by or signer(), random.Random(2))


def read(datagram: bytes, code: JoinCode = CODE, secret: bytes = SECRET) -> VerifiedReply | UnsignedRefusal:
    """Return the reply as the newcomer decodes it."""
    return join_codec.open_reply(datagram, code, DOG, secret)


def knocked(wish: str = "dog") -> bytes:
    return join_codec.make_request(CODE.key, DOG, EPHEMERAL, wish, random.Random(1))


class JoinCodecTests(SynchronousTestCase):
    def test_knock_is_read_as_it_was_said(self) -> None:
        """A bootstrap node that knows the invitation decodes the newcomer's key, requested name and proof."""
        said = knocked()
        found = join_codec.open_request(said, INVITE.public)
        self.assertEqual((found.public, found.ephemeral, found.requested_name), (DOG, EPHEMERAL, "dog"))
        self.assertTrue(is_join_signature(INVITE.public, DOG, "dog", found.proof))
        self.assertFalse(is_join_signature(INVITE.public, DOG, "cat", found.proof))

    def test_knock_hides_who_comes(self) -> None:
        """A join request (JOIN_REQUEST) hides the key and the name, and always has the maximum datagram size."""
        said = knocked()
        self.assertNotIn(DOG, said)
        self.assertEqual({len(knocked(name)) for name in ("", "dog", "n" * 40)}, {1400})

    def test_welcome_is_read_as_it_was_given(self) -> None:
        """The newcomer decodes the join reply.

        A full reply omits contacts so that it stays smaller than the request.
        """
        said = welcomed()
        self.assertLessEqual(len(said), join_codec.JOIN_REQUEST_BYTES)
        found = read(said)
        assert isinstance(found, VerifiedReply) and isinstance(found.content, JoinReply)
        self.assertEqual(
            (found.content.certificate, found.content.secrets), (b"p" * MAX_CERTIFICATE_BYTES, JOIN_REPLY.secrets)
        )
        self.assertEqual(found.terms, CONTENT)
        self.assertEqual(found.content.contacts, CONTACTS[: len(found.content.contacts)])
        self.assertGreater(len(found.content.contacts), 1)

    def test_welcome_is_for_one(self) -> None:
        """A join reply cannot be decrypted with a different ephemeral key or code, or by a different newcomer."""
        other = invited(OPERATOR, seed=2)[0]
        self.assertRaises(Forged, read, welcomed(), CODE, b"x" * 32)
        self.assertRaises(Forged, read, welcomed(), other)
        self.assertRaises(Forged, join_codec.open_reply, welcomed(), CODE, identity("cat").public, SECRET)

    def test_only_a_bootstrap_node_answers(self) -> None:
        """A reply of a member without the role bootstrap, or with the terms of a different code, is forged."""
        self.assertRaises(Forged, read, welcomed(signer(role="device")))
        self.assertRaises(Forged, read, welcomed(signer(code=invited(OPERATOR, seed=2)[0])))
        self.assertRaises(Forged, read, welcomed(replace(signer(), identity=identity("eye"))))

    def test_refusals_have_names(self) -> None:
        """A rejection arrives with its code, or with "unknown" for an unrecognized code.

        A hint (an unsigned rejection) is decoded as a hint.
        """
        for code, meant in (("used", "used"), ("silly", "unknown")):
            said = join_codec.make_refusal(INVITE.public, HEARD, code, signer(), random.Random(2))
            self.assertEqual(read(said), VerifiedReply(CONTENT, meant))
        name = join_codec.read_invitation_id(knocked())
        for code, meant in (("", "unknown"), ("role", "role"), ("silly", "unknown")):
            self.assertEqual(read(join_codec.make_unsigned_refusal(name, code)), UnsignedRefusal(meant))

    @given(st.integers(0, 1399), st.integers(1, 255), st.binary(max_size=1400))
    @settings(max_examples=200, deadline=None)
    def test_reads_anything(self, place: int, change: int, junk: bytes) -> None:
        """Random bytes and datagrams with one changed byte raise ``Forged`` or ``Malformed``."""
        said = bytearray(knocked())
        said[place] ^= change
        self.assertRaises((Forged, Malformed), join_codec.open_request, bytes(said), INVITE.public)
        self.assertRaises((Forged, Malformed), join_codec.open_request, b"\x17" + junk, INVITE.public)
        given = bytearray(welcomed())
        given[1 + place % (len(given) - 1)] ^= change
        self.assertRaises((Forged, Malformed), read, bytes(given))

    @given(st.recursive(st.integers(0, 99) | st.binary(max_size=70) | st.text(max_size=5), st.lists, max_leaves=20))
    @settings(max_examples=200, deadline=None)
    def test_a_bootstrap_node_may_sign_anything(self, body: object) -> None:
        """A signed reply with arbitrary content is decoded as a rejection or raises ``Malformed``."""
        whole = join_codec._sign_body(INVITE.public, HEARD, msgpack.packb(body), signer())
        said = join_codec._encrypt_reply(INVITE.public, EPHEMERAL, whole, random.Random(2))
        with contextlib.suppress(Malformed):
            found = read(said)
            self.assertTrue(isinstance(found, VerifiedReply) and isinstance(found.content, str))
