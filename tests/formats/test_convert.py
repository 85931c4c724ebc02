"""Tests of ``formats.convert``."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Literal

from msgspec import Meta
from twisted.trial.unittest import SynchronousTestCase

from formats.convert import (
    FINITE,
    PRINTABLE,
    UNIQUE,
    ConversionStep,
    InvalidValue,
    Secret,
    Unit,
    convert_field,
    convert_table,
)


def _shout(word: str) -> str:
    if word == "hush":
        raise ValueError("is too quiet")
    return word.upper()


@dataclass(frozen=True)
class _Part:
    kind: str
    size: int = 0


@dataclass(frozen=True)
class _Table:
    name: Annotated[str, Meta(min_length=1, max_length=8, examples=["dog1"]), PRINTABLE]
    port: Annotated[int, Meta(ge=0, le=65535)] = 80
    rate: Annotated[float, Meta(gt=0, le=60), Unit("s")] = 1.0
    mode: Literal["safe", "full"] = "safe"
    sizes: Annotated[tuple[Annotated[int, Meta(ge=0)], ...], Meta(max_length=3), UNIQUE] = ()
    parts: tuple[_Part, ...] = ()
    word: Annotated[bytes, Meta(description="a loud word"), ConversionStep(_shout, raw=str)] = b""
    key: Annotated[str, Meta(min_length=8), Secret()] = field(default="", repr=False)
    x: Annotated[float, FINITE] = 0.0
    on: bool = False


class ConvertTests(SynchronousTestCase):
    """Values are converted to the declared types; an error contains the key, the problem and a remedy."""

    def refused(self, key: str, value: object) -> InvalidValue:
        """Return the error message for an invalid value."""
        error: InvalidValue = self.assertRaises(InvalidValue, convert_table, {"name": "a", key: value}, _Table)
        self.assertEqual(error.key, key)
        self.assertTrue(error.problem and error.remedy)
        return error

    def test_converts(self) -> None:
        """Integers become floats where floats are declared, and lists become tuples.

        After this conversion the ``ConversionStep`` is applied.
        """
        given = {"name": "a", "rate": 2, "sizes": [1, 1, 2], "parts": [{"kind": "camera"}], "word": "ay"}
        table = convert_table(given, _Table)
        self.assertEqual(table, _Table("a", 80, 2.0, "safe", (1, 2), (_Part("camera"),), "AY"))  # type: ignore[arg-type]
        self.assertIsInstance(table.rate, float)

    def test_refuses_wrong_types_and_bounds(self) -> None:
        """Values are not coerced: neither a boolean nor a text is a number, and NaN is in no range."""
        nan, inf = float("nan"), float("inf")
        wrong: dict[str, list[object]] = {
            "name": ["", "x" * 9, 1, None, "a\nb"],
            "port": [-1, 65536, 1.0, True, "80", None],
            "rate": [0, 61, True, "1", nan, inf],
            "mode": ["", "Safe", 1, ["safe"], {}],
            "sizes": [1, "1", [-1], [1.5], [1, 2, 3, 4]],
            "parts": [{}, [1], [{}], [{"kind": 7}], [{"kind": "a", "size": "b"}]],
            "word": ["hush", 7],
            "key": ["short", 7],
            "x": [nan, inf, -inf],
        }
        for key, values in wrong.items():
            for value in values:
                self.refused(key, value)

    def test_names_the_innermost_value(self) -> None:
        """The error for a list or table identifies the invalid entry and shows its value."""
        self.assertIn("[1] is -5", self.refused("sizes", [1, -5]).problem)
        self.assertIn('[0].size is "b"', self.refused("parts", [{"kind": "a", "size": "b"}]).problem)

    def test_hides_secrets(self) -> None:
        """A secret is not shown in an error."""
        error = self.refused("key", "hunter2")
        self.assertNotIn("hunter2", error.problem + error.remedy)

    def test_says_what_is_known(self) -> None:
        """The error for an unknown key suggests the nearest key; the error for a missing key contains an example."""
        error = self.assertRaises(InvalidValue, convert_table, {"nam": "a"}, _Table)
        self.assertIn("nearest is name", error.remedy)
        error = self.assertRaises(InvalidValue, convert_table, {}, _Table)
        self.assertEqual(error.key, "name")
        self.assertIn("dog1", error.remedy)
        self.assertEqual(self.assertRaises(InvalidValue, convert_table, [], _Table).key, "")

    def test_reads_a_command_line(self) -> None:
        """Numbers, booleans and comma-separated lists are parsed from command-line text."""
        self.assertEqual(convert_field("8080", _Table, "port", is_text=True), 8080)
        self.assertEqual(convert_field("1, 2,", _Table, "sizes", is_text=True), (1, 2))
        self.assertIs(convert_field("true", _Table, "on", is_text=True), True)
        for word in ("1", "yes", "True", ""):
            self.assertRaises(InvalidValue, convert_field, word, _Table, "on", is_text=True)
        self.assertRaises(InvalidValue, convert_field, "many", _Table, "port", is_text=True)
