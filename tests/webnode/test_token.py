"""Tests of ``webnode.token``: signed tokens, each accepted only by the web node to which it is addressed."""

from __future__ import annotations

import random
from dataclasses import replace
from typing import Any

import msgpack
from hypothesis import given
from hypothesis import strategies as st
from itsdangerous.encoding import base64_encode
from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.identity import Identity
from webnode.token import MAX_NAME, MAX_TEXT, MAX_VOUCHERS, SIGNATURE_DOMAIN, Claim, TokenKey, encode_claim

VAIO, PI, EVE = (TokenKey(Identity(bytes([n]) * 32)) for n in (1, 2, 3))
CLAIM = Claim("ab" * 8, "operator", "operator", 2_000_000_000, limit=2_000_100_000)


class TokenTests(SynchronousTestCase):
    def test_read_what_was_signed(self) -> None:
        """A node accepts a token that it signed, and appears in the token's list of vouchers.

        Other nodes reject the token.
        """
        for claim in (CLAIM, CLAIM.ticket, replace(CLAIM, role="phone", name="Z\N{SNOWMAN}", parents=("cd" * 8,))):
            text = VAIO.sign_token(claim)
            self.assertRegex(text, r"^[\w.-]+$")
            self.assertEqual(VAIO.read_claim(text), replace(claim, vouchers=(VAIO.public,)))
            self.assertIsNone(PI.read_claim(text))

    def test_read_what_is_for_it(self) -> None:
        """Only the node to which a token is addressed accepts it; the list of earlier vouchers is kept."""
        claim = replace(CLAIM, vouchers=(EVE.public,))
        text = VAIO.sign_token(claim, PI.node_id)
        self.assertEqual(PI.read_claim(text), replace(claim, vouchers=(EVE.public, VAIO.public)))
        self.assertEqual([key.read_claim(text) for key in (VAIO, EVE)], [None, None])
        self.assertEqual(VAIO.sign_token(CLAIM, VAIO.node_id), VAIO.sign_token(CLAIM))

    def test_a_ticket_lets_less(self) -> None:
        """The ticket of an operator has the role viewer; the ticket of a phone has the role phone."""
        roles: dict[Any, str] = {"operator": "viewer", "viewer": "viewer", "phone": "phone"}
        for role, less in roles.items():
            ticket = replace(CLAIM, role=role).ticket
            self.assertEqual((ticket.role, ticket.is_ticket), (less, True))

    def test_fit_into_its_places(self) -> None:
        """An invitation fits into a QR code, the longest token is accepted, and a long name is truncated."""
        self.assertLess(len(VAIO.sign_token(replace(CLAIM, name="guest"))), 140)
        others = tuple(bytes([n]) * 32 for n in range(MAX_VOUCHERS))
        longest = replace(CLAIM, name="\N{SNOWMAN}" * 99, parents=("cd" * 8,) * 3, vouchers=others)
        text = VAIO.sign_token(longest, PI.node_id)
        self.assertLessEqual(len(text), MAX_TEXT)
        read = PI.read_claim(text)
        assert read is not None
        self.assertEqual((len(read.name), len(read.vouchers)), (MAX_NAME, MAX_VOUCHERS + 1))

    def test_refuse_each_change(self) -> None:
        """A token that is changed, truncated or extended anywhere is invalid."""
        for text in (VAIO.sign_token(CLAIM), VAIO.sign_token(CLAIM, PI.node_id)):
            reader = VAIO if VAIO.read_claim(text) else PI
            for at in range(len(text) - 2):  # not every bit of the last letter is significant
                changed = text[:at] + ("A" if text[at] != "A" else "B") + text[at + 1 :]
                self.assertIsNone(reader.read_claim(changed), at)
            for other in (text[:-4], text + "AAAA", f"A.{text}", text.replace(".", ".."), text * 5):
                self.assertIsNone(reader.read_claim(other))

    def test_refuse_what_is_signed_for_something_else(self) -> None:
        """A signature of the same key for another purpose is invalid."""
        identity = Identity(bytes([1]) * 32)
        value = base64_encode(encode_claim(CLAIM))

        def is_token(domain: bytes) -> bool:
            return VAIO.read_claim((value + b"." + base64_encode(identity.sign(domain + value))).decode()) is not None

        found = [is_token(domain) for domain in (SIGNATURE_DOMAIN, b"", b"swarm-record-1", b"swarm-page-2 ")]
        self.assertEqual(found, [True, False, False, False])

    def test_refuse_unlawful_content(self) -> None:
        """Content that is signed but invalid is rejected."""
        identity = Identity(bytes([3]) * 32)
        lawful: list[Any] = msgpack.unpackb(encode_claim(CLAIM, PI.node_id))
        contents: list[Any] = [7, [], {}, None, lawful[:-1], [*lawful, 1]]
        value: Any
        for at in range(len(lawful)):
            for value in (None, -1, 2**63, "x", b"x", [1], [b"x"], {}, 1.5, True):
                if value != lawful[at] and not (at in (2, 3) and value in (True,)) and not (at == 5 and value == "x"):
                    contents.append([*lawful[:at], value, *lawful[at + 1 :]])
        contents.append([*lawful[:6], [bytes(8)] * 9, [], PI.node_id])
        contents.append([*lawful[:6], [], [bytes(32)] * 9, PI.node_id])
        for content in contents:
            value = base64_encode(identity.public) + b"." + base64_encode(msgpack.packb(content))
            text = (value + b"." + base64_encode(identity.sign(SIGNATURE_DOMAIN + value))).decode()
            self.assertIsNone(PI.read_claim(text), content)

    @given(st.text(max_size=700))
    def test_bear_any_text(self, text: str) -> None:
        """Any text is rejected without an exception."""
        for each in (text, f"{text}.{text}", f"{base64_encode(EVE.public).decode()}.{text}.{text}"):
            self.assertIsNone(VAIO.read_claim(each))

    def test_bear_keys_of_any_length(self) -> None:
        """Keys of a wrong length are rejected without an exception."""
        dice = random.Random(1)
        for length in (0, 1, 31, 33, 64, 200):
            key = base64_encode(dice.randbytes(length)).decode()
            self.assertIsNone(PI.read_claim(f"{key}.AAAA.{'A' * 86}"))
