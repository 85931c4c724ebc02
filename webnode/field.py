"""Lawful values out of foreign ones: records come from other nodes, so nothing in them is believed.

Each function returns a value that JSON can carry and a page can show; what cannot be one becomes the fallback.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

MAX_TEXT = 300
MAX_ENTRIES = 64

Json = None | bool | int | float | str | list["Json"] | dict[str, "Json"]


def text(value: object, fallback: str = "", limit: int = MAX_TEXT) -> str:
    """``value`` where it is text, without control characters and lone surrogates, at most ``limit`` characters."""
    if not isinstance(value, str):
        return fallback
    shown = value[:limit]
    if not shown.isprintable():
        shown = "".join(c if c.isprintable() else " " for c in shown)
    return shown.strip() or fallback


def number(value: object, fallback: float = 0.0) -> float:
    """``value`` where it is a finite number (JSON has no NaN)."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return fallback
    try:
        finite = float(value)
    except OverflowError:
        return fallback
    return finite if math.isfinite(finite) else fallback


def count(value: object, fallback: int = 0) -> int:
    """``value`` where it is a whole number that a browser keeps exactly."""
    return value if type(value) is int and abs(value) < 2**53 else fallback


def distance(value: object) -> float | None:
    """``value`` where it is a finite length of zero or more, else None: nothing was measured."""
    length = number(value, -1.0)
    return length if length >= 0.0 else None


def texts(value: object) -> list[str]:
    """The lawful texts of a list."""
    if not isinstance(value, list | tuple):
        return []
    return [entry for entry in (text(each) for each in value[:MAX_ENTRIES]) if entry]


def properties(value: object) -> dict[str, dict[str, str | float]]:
    """Capability names to properties, each a number or a text; properties that are neither are left out."""
    found: dict[str, dict[str, str | float]] = {}
    if not isinstance(value, Mapping):
        return found
    for name, entries in list(value.items())[:MAX_ENTRIES]:
        if not text(name):
            continue
        kept: dict[str, str | float] = {}
        if isinstance(entries, Mapping):
            for key, entry in list(entries.items())[:MAX_ENTRIES]:
                if isinstance(entry, str) and text(key):
                    kept[text(key)] = text(entry)
                elif isinstance(entry, int | float) and math.isfinite(number(entry, math.inf)) and text(key):
                    kept[text(key)] = number(entry)
        found[text(name)] = kept
    return found
