"""Sanitize values from records of other nodes, which are not trusted.

Each function returns a value that JSON can carry and a page can show, or the fallback for an invalid value.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

MAX_TEXT = 300
MAX_ENTRIES = 64

Json = None | bool | int | float | str | list["Json"] | dict[str, "Json"]


def clean_text(value: object, fallback: str = "", limit: int = MAX_TEXT) -> str:
    """Return ``value`` if it is text, without control characters and lone surrogates, cut to ``limit`` characters."""
    if not isinstance(value, str):
        return fallback
    shown = value[:limit]
    if not shown.isprintable():
        shown = "".join(c if c.isprintable() else " " for c in shown)
    return shown.strip() or fallback


def clean_number(value: object, fallback: float = 0.0) -> float:
    """Return ``value`` if it is a finite number (JSON has no NaN)."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return fallback
    try:
        finite = float(value)
    except OverflowError:
        return fallback
    return finite if math.isfinite(finite) else fallback


def clean_count(value: object, fallback: int = 0) -> int:
    """Return ``value`` if it is an integer that JavaScript represents exactly."""
    return value if type(value) is int and abs(value) < 2**53 else fallback


def clean_distance(value: object) -> float | None:
    """Return ``value`` if it is a finite length of zero or more; otherwise None (not measured)."""
    length = clean_number(value, -1.0)
    return length if length >= 0.0 else None


def clean_texts(value: object) -> list[str]:
    """Return the valid strings of a list."""
    if not isinstance(value, list | tuple):
        return []
    return [entry for entry in (clean_text(each) for each in value[:MAX_ENTRIES]) if entry]


def clean_properties(value: object) -> dict[str, dict[str, str | float]]:
    """Map capability names to properties, each a number or a string; other properties are left out."""
    found: dict[str, dict[str, str | float]] = {}
    if not isinstance(value, Mapping):
        return found
    for name, entries in list(value.items())[:MAX_ENTRIES]:
        if not clean_text(name):
            continue
        valid: dict[str, str | float] = {}
        if isinstance(entries, Mapping):
            for key, entry in list(entries.items())[:MAX_ENTRIES]:
                if isinstance(entry, str) and clean_text(key):
                    valid[clean_text(key)] = clean_text(entry)
                elif (
                    isinstance(entry, int | float) and math.isfinite(clean_number(entry, math.inf)) and clean_text(key)
                ):
                    valid[clean_text(key)] = clean_number(entry)
        found[clean_text(name)] = valid
    return found
