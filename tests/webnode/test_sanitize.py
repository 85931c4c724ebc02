"""Tests of ``webnode.sanitize``."""

from __future__ import annotations

import json

from hypothesis import given, settings
from hypothesis import strategies as st
from twisted.trial.unittest import SynchronousTestCase

from webnode.sanitize import clean_count, clean_distance, clean_number, clean_properties, clean_text, clean_texts


class SanitizeTests(SynchronousTestCase):
    def test_take_lawful_values(self) -> None:
        """Valid values are returned unchanged."""
        self.assertEqual(clean_text("dog1"), "dog1")
        self.assertEqual(clean_number(0.5), 0.5)
        self.assertEqual(clean_count(3), 3)
        self.assertEqual(clean_distance(0), 0.0)
        self.assertEqual(clean_texts(["edge", "web"]), ["edge", "web"])
        self.assertEqual(
            clean_properties({"camera": {"fps": 30, "model": "x"}}), {"camera": {"fps": 30.0, "model": "x"}}
        )

    def test_refuse_what_json_cannot_carry(self) -> None:
        """NaN, infinities, huge integers, booleans and negative lengths are replaced by the default."""
        for value in (float("nan"), float("inf"), 10**400, True, "1", None):
            self.assertEqual(clean_number(value, -7.0), -7.0)
        self.assertEqual(clean_count(2**60, 5), 5)
        self.assertIsNone(clean_distance(-1.0))

    def test_clean_text(self) -> None:
        """Control characters become spaces, and text is truncated at its limit."""
        self.assertEqual(clean_text("a\x00\x1b[31mb"), "a  [31mb")
        self.assertEqual(clean_text("x" * 500, limit=10), "x" * 10)
        self.assertEqual(clean_text("\x07", "nothing"), "nothing")

    @settings(max_examples=150)
    @given(
        st.recursive(
            st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8) | st.binary(max_size=8),
            lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=4), inner, max_size=4),
            max_leaves=8,
        )
    )
    def test_survive_anything(self, value: object) -> None:
        """Any value in a record is converted to valid JSON in UTF-8."""
        outcome = [
            clean_text(value),
            clean_number(value),
            clean_count(value),
            clean_distance(value),
            clean_texts(value),
            clean_properties(value),
        ]
        sent = json.dumps(outcome, allow_nan=False, ensure_ascii=False).encode()
        self.assertEqual(json.loads(sent), outcome)
