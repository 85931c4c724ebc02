"""Word: values as words of a shell and as JSON; the same for every verb, in both directions.

JSON has no bytes: bytes that are UTF-8 text are shown as that text, others as ``{"base64": "..."}``, which is also read
back.  A tuple's text stays text, its bytes are always ``{"base64": ...}``, since there the two differ.

Any member of the team chooses its own words, and records keep them as they are.  What would move a terminal's cursor
is taken out where they are shown, and nowhere else: a node that refused them would see another team than the others.
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
ANY = "_"


class BadWord(ValueError):
    """A word that no value can be read from."""


def text_or_base64(data: bytes) -> Any:
    """Bytes for JSON: text where they are text."""
    try:
        return data.decode()
    except UnicodeDecodeError:
        return plain(data)


def plain(value: Any) -> Any:
    """A tuple's field, or a method's answer, for JSON."""
    if isinstance(value, bytes):
        return {"base64": base64.b64encode(value).decode()}
    if isinstance(value, list | tuple):
        return [plain(each) for each in value]
    if isinstance(value, dict):
        return {key if isinstance(key, str) else str(text_or_base64(key)): plain(each) for key, each in value.items()}
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    return value


def value(field: Any) -> Any:
    """What ``plain`` made of a value, as that value; raises ``BadWord``."""
    if isinstance(field, dict) and set(field) == {"base64"}:
        try:
            return base64.b64decode(field["base64"], validate=True)
        except (binascii.Error, TypeError, ValueError) as error:
            raise BadWord(f"no base64: {json.dumps(field)[:60]}") from error
    if isinstance(field, list):
        return [value(each) for each in field]
    return field


def scalar(word: str) -> Any:
    """A field out of a word: JSON where it is JSON (``7``, ``true``, ``null``, ``"7"``), else the text itself."""
    try:
        read = json.loads(word, parse_constant=_refused)
    except (ValueError, RecursionError):
        return word
    if isinstance(read, list) or (isinstance(read, dict) and set(read) != {"base64"}):
        raise BadWord(f'a field is a number, text, true, false, null or {{"base64": ...}}, not {word[:60]}')
    return read


def pattern(word: str) -> Any:
    """A template's field out of a word: ``_`` any, ``?int`` a kind, ``>5`` ``!=red`` a predicate, else a value."""
    if word == ANY:
        return {"any": True}
    if word.startswith("?"):
        if word[1:] not in KINDS:
            raise BadWord(f"{word!r}: a kind is one of ?{', ?'.join(KINDS)}")
        return {"kind": word[1:]}
    for operator in OPERATORS:
        if word.startswith(operator):
            return {"operator": operator, "operand": scalar(word.removeprefix(operator))}
    if found := re.fullmatch(r"(in|prefix):(.*)", word, re.DOTALL):
        operator, rest = found.groups()
        operand = [scalar(each) for each in rest.split(",")] if operator == "in" else rest
        return {"operator": operator, "operand": operand}
    return scalar(word)


def shown(fields: Sequence[Any]) -> str:
    """A tuple for a person: its fields as JSON, side by side."""
    return " ".join(written(plain(field)) for field in fields)


def printable(text: str) -> str:
    """Somebody's words as a terminal may be shown them, on one line: each control character is a space."""
    return "".join(c if c.isprintable() else " " for c in text)


def written(value: Any) -> str:
    """Plain JSON on one line that a terminal may be shown; read back it is the same value."""
    text = json.dumps(value, ensure_ascii=False)
    return "".join(c if c.isprintable() else json.dumps(c)[1:-1] for c in text)


def _refused(constant: str) -> Any:
    raise ValueError(constant)
