"""Tests of ``control.conversion``, which converts values to and from shell words and JSON."""

from __future__ import annotations

import json
from typing import Any

from hypothesis import given
from hypothesis import strategies as st
from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.control import conversion

FIELDS = st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text()


class ConversionTests(SynchronousTestCase):
    @given(st.lists(FIELDS | st.binary()))
    def test_fields_come_back_from_json(self, fields: list[Any]) -> None:
        """Every tuple, including bytes, survives conversion to JSON and back, and no text becomes bytes."""
        there = json.loads(json.dumps(conversion.to_json(fields)))
        back = conversion.from_json(there)
        self.assertEqual(back, fields)
        self.assertEqual([type(field) for field in back], [type(field) for field in fields])

    @given(FIELDS)
    def test_json_is_read_as_a_field(self, field: Any) -> None:
        """A field that was converted to JSON is parsed as the same field."""
        self.assertEqual(conversion.parse_field(json.dumps(field)), field)

    @given(st.text())
    def test_every_word_is_read_or_refused(self, text: str) -> None:
        """Any word on a command line is parsed as a field or a template field, or raises ``InvalidValue``."""
        for read in (conversion.parse_field, conversion.parse_template_field):
            try:
                field = read(text)
            except conversion.InvalidValue:
                continue
            self.assertIsInstance(field, bool | int | float | str | dict | None)

    def test_words_that_are_no_json_are_text(self) -> None:
        """A word that is not JSON is text, even a number that JSON does not have, such as NaN."""
        for text in ("red", "dog 1", "", "007", "NaN", "[", "-"):
            self.assertEqual(conversion.parse_field(text), text)
        self.assertRaises(conversion.InvalidValue, conversion.parse_field, "[1, 2]")
        self.assertRaises(conversion.InvalidValue, conversion.parse_field, '{"a": 1}')

    def test_patterns(self) -> None:
        """A word in a template is a wildcard, a type, a predicate or a value; a quoted word is always a value."""
        for text, meant in (
            ("_", {"any": True}),
            ("?int", {"kind": "int"}),
            (">5", {"operator": ">", "operand": 5}),
            ("<=1.5", {"operator": "<=", "operand": 1.5}),
            ("!=red", {"operator": "!=", "operand": "red"}),
            ("in:1,b", {"operator": "in", "operand": [1, "b"]}),
            ("prefix:job-", {"operator": "prefix", "operand": "job-"}),
            ("7", 7),
            ("job", "job"),
            ('"_"', "_"),
            ('"?int"', "?int"),
        ):
            self.assertEqual(conversion.parse_template_field(text), meant)
        self.assertIn(
            "?int", str(self.assertRaises(conversion.InvalidValue, conversion.parse_template_field, "?number"))
        )

    @given(st.text())
    def test_what_a_terminal_is_shown(self, text: str) -> None:
        """Control characters become spaces in text.

        In JSON they become escapes, which are parsed as the original characters.
        """
        self.assertTrue(conversion.remove_control_characters(text).isprintable())
        self.assertEqual(len(conversion.remove_control_characters(text)), len(text))
        written = conversion.format_json({text: [text]})
        self.assertTrue(written.isprintable())
        self.assertEqual(json.loads(written), {text: [text]})

    def test_bytes_for_people(self) -> None:
        """UTF-8 values are shown as text and others as base64; text that resembles base64 does not become bytes."""
        self.assertEqual(conversion.text_or_base64("dög".encode()), "dög")
        self.assertEqual(conversion.text_or_base64(b"\xff\x00"), {"base64": "/wA="})
        self.assertRaises(conversion.InvalidValue, conversion.from_json, {"base64": "!"})
        self.assertRaises(conversion.InvalidValue, conversion.from_json, [{"base64": 7}])
        self.assertEqual(
            conversion.to_json({"a": float("inf"), b"k": (1, b"x")}), {"a": "inf", "k": [1, {"base64": "eA=="}]}
        )
        self.assertEqual(conversion.format_tuple(("job", 7, None)), '"job" 7 null')
        self.assertEqual(conversion.format_tuple(("dög\x9b2J\u202e",)), '"dög\\u009b2J\\u202e"')
