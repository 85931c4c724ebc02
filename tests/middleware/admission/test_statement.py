"""Tests of the statements that an operator signs."""

from __future__ import annotations

import random
from typing import Any

import msgpack
from hypothesis import given, settings
from hypothesis import strategies as st
from twisted.trial.unittest import SynchronousTestCase

from middleware.admission.statement import (
    MAX_LIFE_S,
    MAX_SECRET_RECIPIENTS,
    Grant,
    Invite,
    Revocation,
    Secret,
    open_statement,
    seal_secret,
    sign_statement,
)
from middleware.entangled.errors import Forged, Malformed
from tests.middleware.admission.paper import NOW, identity, operator

DOG, CAT = identity("dog"), identity("cat")
GRANT = Grant(DOG.public, "dog", ("device", "bootstrap"), NOW, NOW + 10)
INVITE = Invite(DOG.public, "dog", ("viewer",), 3, NOW, NOW + 10, 1000)
REVOKE = Revocation(DOG.public, "dog", NOW, NOW + MAX_LIFE_S)


class StatementTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.operator = operator().identity
        self.secret = seal_secret(b"s" * 32, 2, [DOG.public], NOW, 60, random.Random(1))

    def test_each_is_read_as_it_was_signed(self) -> None:
        """Every kind of statement survives packing and unpacking."""
        for each in (GRANT, INVITE, REVOKE, self.secret):
            self.assertEqual(open_statement(self.operator.public, sign_statement(self.operator, each)), each)

    def test_only_this_operator_counts(self) -> None:
        """Statements of another operator, and statements with any changed bit, are rejected."""
        packed = sign_statement(self.operator, GRANT)
        self.assertRaises(Forged, open_statement, operator(2).public, packed)
        for place in range(len(packed)):
            changed = packed[:place] + bytes([packed[place] ^ 1]) + packed[place + 1 :]
            self.assertRaises((Forged, Malformed), open_statement, self.operator.public, changed)

    def test_secret_opens_for_those_that_stay(self) -> None:
        """Only the members for which a new team secret was sealed can decrypt it."""
        self.assertEqual(self.secret.decrypt(DOG), b"s" * 32)
        self.assertIsNone(self.secret.decrypt(CAT))
        stolen = Secret(2, NOW, 60, NOW + 100, self.secret.fingerprint, ((CAT.public, self.secret.sealed[0][1]),))
        self.assertIsNone(stolen.decrypt(CAT))

    def test_secret_for_many(self) -> None:
        """A secret that is sealed for the maximum number of members can be signed and read."""
        keys = [identity(str(number)).public for number in range(MAX_SECRET_RECIPIENTS)]
        secret = seal_secret(b"s" * 32, 2**40, keys, NOW, MAX_LIFE_S, random.Random(1))
        self.assertEqual(open_statement(self.operator.public, sign_statement(self.operator, secret)), secret)

    def test_unlawful_is_not_signed(self) -> None:
        """A statement is rejected before signing if it has an empty name, no role, no lifetime or too many uses."""
        wrong: list[Any] = [
            Grant(DOG.public, "", ("device",), NOW, NOW + 1),
            Grant(DOG.public, "dog", (), NOW, NOW + 1),
            Grant(DOG.public, "dog", ("device",), NOW, NOW),
            Grant(DOG.public[:-1], "dog", ("device",), NOW, NOW + 1),
            Invite(DOG.public, "dog", ("device",), 0, NOW, NOW + 1, 1),
            Invite(DOG.public, "dog", ("device",), 101, NOW, NOW + 1, 1),
            Secret(1, NOW, 1, NOW + 1, bytes(16), ()),
        ]
        for each in wrong:
            self.assertRaises(ValueError, sign_statement, self.operator, each)

    def test_one_form_only(self) -> None:
        """A non-canonical encoding of a statement is malformed, because a statement must have only one digest."""
        packed = sign_statement(self.operator, REVOKE)
        fields = msgpack.unpackb(packed)
        longer = b"\xdc" + len(fields).to_bytes(2) + packed[1:]
        self.assertEqual(msgpack.unpackb(longer), fields)
        self.assertRaises(Malformed, open_statement, self.operator.public, longer)

    @given(
        st.binary(max_size=300)
        | st.lists(st.integers() | st.binary(max_size=70) | st.text(max_size=8), max_size=9).map(
            lambda fields: msgpack.packb([f % 2**63 if isinstance(f, int) else f for f in fields])
        )
    )
    @settings(max_examples=400, deadline=None)
    def test_reads_anything(self, packed: bytes) -> None:
        """Any bytes are decoded or raise ``Malformed`` or ``Forged``, and no other exception."""
        self.assertRaises((Forged, Malformed), open_statement, operator().public, packed)
