"""Tests of ``webnode.seal``: tokens that any web node of the team knows again."""

from __future__ import annotations

import base64

from twisted.trial.unittest import SynchronousTestCase

from webnode.seal import MAX_NAME, Claim, Seal

CLAIM = Claim("0123456789abcdef", "operator", "operator", 1_900_000_000)


class SealTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.seal = Seal(b"the team's secret")

    def test_read_what_another_node_of_the_team_made(self) -> None:
        """A token says at every node of the team what was put into it, whatever the role and the name."""
        for claim in (CLAIM, CLAIM.ticket, Claim("00" * 8, "Zoë \N{DOG FACE}", "phone", 2**39)):
            self.assertEqual(Seal(b"the team's secret").claim(self.seal.text(claim)), claim)

    def test_refuse_the_token_of_another_team(self) -> None:
        """A token that was made with another secret says nothing."""
        self.assertIsNone(Seal(b"another secret").claim(self.seal.text(CLAIM)))

    def test_refuse_a_token_that_was_changed(self) -> None:
        """No bit of a token can be changed: not its role, not its time, not its seal."""
        text = self.seal.text(CLAIM)
        data = base64.urlsafe_b64decode(text + "=" * (-len(text) % 4))
        for place in range(8 * len(data)):
            changed = bytearray(data)
            changed[place // 8] ^= 1 << place % 8
            self.assertIsNone(self.seal.claim(base64.urlsafe_b64encode(changed).decode().rstrip("=")), place)

    def test_refuse_what_is_no_token(self) -> None:
        """Anything else is no token, and nothing is raised: empty, short, long, no base64, no ASCII."""
        for text in (
            "",
            "a",
            "AAAA",
            "A" * 24,
            "A" * 100,
            "A" * 10**6,
            "!" * 40,
            "\N{DOG FACE}" * 30,
            "=" * 50,
            "\x00",
        ):
            self.assertIsNone(self.seal.claim(text), text[:20])

    def test_a_ticket_lets_look_only(self) -> None:
        """The ticket of an operator is a viewer's, with the same id, so it ends with the token; a phone's stays one."""
        self.assertEqual((CLAIM.ticket.role, CLAIM.ticket.id, CLAIM.ticket.is_ticket), ("viewer", CLAIM.id, True))
        self.assertEqual(Claim("00" * 8, "x", "phone", 1).ticket.role, "phone")

    def test_fit_into_an_address(self) -> None:
        """A token of the longest name needs no escape in a URL, and a usual one has less than 80 characters."""
        for claim, most in ((CLAIM, 80), (Claim("00" * 8, "n" * MAX_NAME, "viewer", 1), 140)):
            text = self.seal.text(claim)
            self.assertRegex(text, r"^[A-Za-z0-9_-]+$")
            self.assertLess(len(text), most)
