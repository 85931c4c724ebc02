"""Tests of the permanent key pair of a node."""

from __future__ import annotations

from nacl import bindings
from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.identity import ID_BYTES, Identity, derive_exchange_key, derive_node_id, is_signature_valid

DOG = Identity(b"\1" * 32)
CAT = Identity(b"\2" * 32)


class IdentityTest(SynchronousTestCase):
    def test_published_vector(self) -> None:
        """A seed yields the public key and the signature of RFC 8032 (section 7.1, test 2)."""
        seed = bytes.fromhex("4ccd089b28ff96da9db6c346ec114e0f5b8a319f35aba624da8cf6ed4fb8a6fb")
        public = "3d4017c3e843895a92b70aa74d1b7ebc9c982ccf2ec4968cc0cd55f12af4660c"
        signature = (
            "92a009a9f0d4cab8720e820b5f642540a2b27b5416503f8fb3762223ebdb69da"
            "085ac1e43e15996e458f3613d0f11d8c387b2eaeb4302aeeb00d291612bb0c00"
        )
        identity = Identity(seed)
        self.assertEqual(identity.public.hex(), public)
        self.assertEqual(identity.sign(b"\x72").hex(), signature)

    def test_id_follows_from_the_key(self) -> None:
        """The node id is the 160-bit hash of the public key, so a node cannot choose it or use another node's id."""
        self.assertEqual(DOG.node_id, derive_node_id(DOG.public))
        self.assertEqual(len(DOG.node_id), ID_BYTES)
        self.assertNotEqual(DOG.node_id, CAT.node_id)

    def test_signatures(self) -> None:
        """A signature is valid only for its message and its signer; any other input is rejected."""
        signature = DOG.sign(b"sit")
        self.assertTrue(is_signature_valid(DOG.public, b"sit", signature))
        self.assertFalse(is_signature_valid(DOG.public, b"run", signature))
        self.assertFalse(is_signature_valid(CAT.public, b"sit", signature))
        self.assertFalse(is_signature_valid(DOG.public, b"sit", bytes(64)))
        self.assertFalse(is_signature_valid(DOG.public, b"sit", b""))
        self.assertFalse(is_signature_valid(b"short", b"sit", signature))

    def test_both_ends_of_an_exchange_agree(self) -> None:
        """The exchange keys of two nodes give the same shared secret at both nodes."""
        here = bindings.crypto_scalarmult(DOG.exchange_secret, derive_exchange_key(CAT.public))
        there = bindings.crypto_scalarmult(CAT.exchange_secret, derive_exchange_key(DOG.public))
        self.assertEqual(here, there)

    def test_no_key(self) -> None:
        """``exchange_key`` raises ``ValueError`` for bytes that are not a valid public key."""
        for public in (b"", bytes(32), b"\xff" * 32, b"\1" * 31):
            self.assertRaises(ValueError, derive_exchange_key, public)

    def test_secrets_are_not_shown(self) -> None:
        """The ``repr`` of an identity, which may be logged, contains neither the seed nor the secrets."""
        for secret in (DOG.seed, DOG.exchange_secret):
            self.assertNotIn(repr(secret), repr(DOG))
