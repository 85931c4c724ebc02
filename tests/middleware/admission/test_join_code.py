"""Tests of the join code of an invitation."""

from __future__ import annotations

import random

from hypothesis import given, settings
from hypothesis import strategies as st
from twisted.trial.unittest import SynchronousTestCase

from middleware.admission import join_code
from middleware.admission.errors import BadCode
from tests.middleware.admission.paper import operator


class CodeTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.code = join_code.draw_code(operator().public, random.Random(1))

    def test_what_is_read_out_is_what_is_typed(self) -> None:
        """The text of a code has four groups of five characters, and is parsed as the same code and key."""
        self.assertEqual([len(group) for group in self.code.text.split("-")], [5, 5, 5, 5])
        again = join_code.parse_code(self.code.text)
        self.assertEqual((again, again.key.public), (self.code, self.code.key.public))

    def test_hands_are_forgiven(self) -> None:
        """Lower case, other group lengths and letters that look like digits are accepted."""
        meant = join_code.JoinCode(0x1_0001, 0x10)
        self.assertEqual(
            join_code.parse_code(meant.text.replace("0", "o").replace("1", "l").replace("-", " ").lower()), meant
        )

    def test_every_slip_is_noticed(self) -> None:
        """A code with one wrong character, or with two swapped characters, is reported as mistyped."""
        letters = self.code.text.replace("-", "")
        slips = [letters[:at] + other + letters[at + 1 :] for at in range(20) for other in join_code.ALPHABET]
        for first in range(20):
            for second in range(first):
                swapped = list(letters)
                swapped[first], swapped[second] = swapped[second], swapped[first]
                slips.append("".join(swapped))
        for slip in slips:
            if slip != letters:
                self.assertIn("mistyped", str(self.assertRaises(BadCode, join_code.parse_code, slip)))

    def test_length_and_letters_are_named(self) -> None:
        """The error for a code of the wrong length states the length.

        The error for an invalid letter states the letter.
        """
        self.assertIn("has 19", str(self.assertRaises(BadCode, join_code.parse_code, self.code.text[:-1])))
        self.assertIn("'U'", str(self.assertRaises(BadCode, join_code.parse_code, "u" + self.code.text[1:])))

    def test_code_names_its_operator(self) -> None:
        """A code matches the operator that created it, and no other operator."""
        self.assertTrue(self.code.matches_operator(operator().public))
        self.assertFalse(self.code.matches_operator(operator(2).public))

    def test_secret_is_not_shown(self) -> None:
        """The ``repr`` of a code does not contain its secret."""
        self.assertNotIn(str(self.code.secret), repr(self.code))

    @given(st.text(max_size=30) | st.text("0123456789ABCDEFGHJKMNPQRSTVWXYZ-oil", min_size=18, max_size=24))
    @settings(max_examples=300, deadline=None)
    def test_reads_anything(self, text: str) -> None:
        """Any text is parsed as a code or raises ``BadCode``."""
        try:
            found = join_code.parse_code(text)
        except BadCode:
            return
        self.assertEqual(join_code.parse_code(found.text), found)
