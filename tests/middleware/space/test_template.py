"""Tests of tuples and templates."""

from __future__ import annotations

import contextlib
from typing import Any

import msgpack
from hypothesis import given, settings
from hypothesis import strategies as st
from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.errors import Malformed, TooLarge
from middleware.entangled.space.template import (
    ANY,
    OPERATORS,
    BadTuple,
    make_template,
    make_tuple,
    parse_tuple,
    where,
)

VALUES = (
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**64 - 1)
    | st.floats(allow_nan=False)
    | st.text(st.characters(exclude_categories=["Cs"]), max_size=8)
    | st.binary(max_size=8)
)
FOREIGN = st.recursive(
    VALUES | st.floats(),
    lambda inner: st.lists(inner, max_size=5) | st.dictionaries(VALUES, inner, max_size=2),
    max_leaves=12,
)


class TemplateTests(SynchronousTestCase):
    def test_values_match_their_like_only(self) -> None:
        """1, 1.0, True and None are four different values, and each matches only itself."""
        self.assertTrue(make_template(["a", 1, None, b"x"]).matches(("a", 1, None, b"x")))
        for other in (1.0, True, "1", None):
            self.assertFalse(make_template([1]).matches((other,)))

    def test_types_and_wildcards(self) -> None:
        """A type matches only values of this type, ANY matches any value, and a template only tuples of its length."""
        self.assertTrue(make_template([int, str, ANY]).matches((1, "a", None)))
        self.assertFalse(make_template([int]).matches((True,)))
        self.assertFalse(make_template([float]).matches((1,)))
        self.assertFalse(make_template([ANY]).matches(("a", "b")))

    def test_predicates(self) -> None:
        """Each operator gives its specified result, and is false for incomparable values.

        An int can be compared with a float.
        """
        rows: list[tuple[str, Any, Any, bool]] = [
            ("<", 5, 4.5, True), ("<", 5, 5, False), ("<", 5, "a", False), ("<", 5, None, False), ("<", 5, True, False),
            ("<=", 5, 5.0, True), ("<=", "b", "b", True), (">", b"a", b"b", True), (">", b"a", "b", False),
            (">=", 1.5, 1.5, True), (">=", 1.5, 1, False), ("!=", 1, 2, True), ("!=", 1, 1.0, False),
            ("!=", 1, True, True), ("!=", None, None, False), ("!=", "a", b"a", True),
            ("in", ["a", 1], 1, True), ("in", ["a", 1], True, False), ("in", [], 1, False),
            ("prefix", "job-", "job-1", True), ("prefix", "job-", b"job-1", False), ("prefix", b"j", b"job", True),
            ("prefix", b"j", "job", False), ("prefix", "j", 1, False),
        ]  # fmt: skip
        for operator, operand, value, holds in rows:
            self.assertEqual(make_template([where(operator, operand)]).matches((value,)), holds, (operator, value))

    def test_wrong_predicates(self) -> None:
        """An invalid operator or operand raises ``BadTuple``."""
        wrong: list[tuple[Any, Any]] = [
            ("=", 1), ("<", None), ("<", True), ("in", 1), ("in", [1] * 33), ("in", [object()]), ("prefix", 1),
            ("!=", object()), (">", [1]), ("<", float("nan")),
        ]  # fmt: skip
        for operator, operand in wrong:
            self.assertRaises(BadTuple, where, operator, operand)

    def test_wrong_fields(self) -> None:
        """Invalid tuples and templates raise ``BadTuple``, and the message states the index of the invalid field."""
        for wrong in ([], [1] * 33, "text", b"bytes", [object()], [[1]], [2**64], ["\ud800"], [float("nan")], 5):
            self.assertRaises(BadTuple, make_tuple, wrong)
            self.assertRaises(BadTuple, make_template, wrong)
        self.assertRaises(BadTuple, make_tuple, [ANY])
        self.assertRaises(BadTuple, make_template, [list])
        self.assertIn("field 1", str(self.assertRaises(BadTuple, make_tuple, [1, object()])))

    def test_too_large(self) -> None:
        """A tuple that exceeds the size of a record raises ``TooLarge``."""
        self.assertRaises(TooLarge, make_tuple, ["x" * 700])
        self.assertRaises(TooLarge, make_template, [b"x" * 700])

    @settings(max_examples=150)
    @given(fields=st.lists(VALUES, min_size=1, max_size=8))
    def test_tuple_round_trip(self, fields: list[Any]) -> None:
        """Every tuple survives encoding and decoding, and matches itself as a template."""
        back = parse_tuple(msgpack.unpackb(msgpack.packb(list(make_tuple(fields)))))
        self.assertEqual(repr(back), repr(tuple(fields)))
        self.assertTrue(make_template(fields).matches(back))

    @settings(max_examples=300)
    @given(operator=st.sampled_from([*OPERATORS, "=", "like"]), foreign=FOREIGN | st.lists(FOREIGN, max_size=4))
    def test_total(self, operator: str, foreign: Any) -> None:
        """Any input is decoded as a tuple or raises ``Malformed``; any operand is valid or raises ``BadTuple``."""
        with contextlib.suppress(Malformed):
            self.assertIsInstance(parse_tuple(foreign), tuple)
        with contextlib.suppress(BadTuple):
            self.assertIn(where(operator, foreign).holds(1), (True, False))
