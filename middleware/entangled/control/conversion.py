"""Conversion of values between shell words, JSON and tuples, for all verbs.

JSON has no bytes: bytes that are valid UTF-8 become strings; other bytes become ``{"base64": "..."}``, which is also
accepted as input.  In a tuple, where strings and bytes differ, bytes always become ``{"base64": ...}``.

Records contain strings exactly as members of the team wrote them.  Control characters are removed only when a string is
printed, because a node that rejected such records would store different records than other nodes.
"""

from __future__ import annotations

import base64
import binascii
import json
import math
import re
from collections.abc import Sequence
from typing import Any

OPERATORS = ("<=", ">=", "!=", "<", ">")
KINDS = ("int", "float", "str", "bytes", "bool")
ANY_WORD = "_"


class InvalidValue(ValueError):
    """A word is not a valid value."""


def text_or_base64(data: bytes) -> Any:
    """Convert bytes to JSON: a string if they are valid UTF-8, otherwise base64."""
    try:
        return data.decode()
    except UnicodeDecodeError:
        return to_json(data)


def to_json(value: Any) -> Any:
    """Convert a tuple's field or a method's answer to JSON."""
    if isinstance(value, bytes):
        return {"base64": base64.b64encode(value).decode()}
    if isinstance(value, list | tuple):
        return [to_json(each) for each in value]
    if isinstance(value, dict):
        return {key if isinstance(key, str) else str(text_or_base64(key)): to_json(each) for key, each in value.items()}
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    return value


def from_json(field: Any) -> Any:
    """Convert the result of ``to_json`` back to the value; raise ``InvalidValue``."""
    if isinstance(field, dict) and set(field) == {"base64"}:
        try:
            return base64.b64decode(field["base64"], validate=True)
        except (binascii.Error, TypeError, ValueError) as error:
            raise InvalidValue(f"the value is not valid base64: {json.dumps(field)[:60]}") from error
    if isinstance(field, list):
        return [from_json(each) for each in field]
    return field


def parse_field(word: str) -> Any:
    """Parse a word as a field: valid JSON (``7``, ``true``, ``null``, ``"7"``), otherwise a string."""
    try:
        read = json.loads(word, parse_constant=_reject_constant)
    except (ValueError, RecursionError):
        return word
    if isinstance(read, list) or (isinstance(read, dict) and set(read) != {"base64"}):
        raise InvalidValue(f'a field must be a number, string, true, false, null or {{"base64": ...}}, not {word[:60]}')
    return read


def parse_template_field(word: str) -> Any:
    """Parse a template field: ``_`` (any value), ``?int`` (a type), ``>5`` or ``!=red`` (a predicate), or a value."""
    if word == ANY_WORD:
        return {"any": True}
    if word.startswith("?"):
        if word[1:] not in KINDS:
            raise InvalidValue(f"{word!r}: the type must be one of ?{', ?'.join(KINDS)}")
        return {"kind": word[1:]}
    for operator in OPERATORS:
        if word.startswith(operator):
            return {"operator": operator, "operand": parse_field(word.removeprefix(operator))}
    if found := re.fullmatch(r"(in|prefix):(.*)", word, re.DOTALL):
        operator, rest = found.groups()
        operand = [parse_field(each) for each in rest.split(",")] if operator == "in" else rest
        return {"operator": operator, "operand": operand}
    return parse_field(word)


def format_tuple(fields: Sequence[Any]) -> str:
    """Format a tuple for printing: its fields as JSON, separated by spaces."""
    return " ".join(format_json(to_json(field)) for field in fields)


def remove_control_characters(text: str) -> str:
    """Replace control characters by spaces, for printing a string of a peer on one line of a terminal."""
    return "".join(c if c.isprintable() else " " for c in text)


def format_json(value: Any) -> str:
    """Format JSON on one line with control characters escaped, safe for a terminal."""
    text = json.dumps(value, ensure_ascii=False)
    return "".join(c if c.isprintable() else json.dumps(c)[1:-1] for c in text)


def _reject_constant(constant: str) -> Any:
    raise ValueError(constant)
