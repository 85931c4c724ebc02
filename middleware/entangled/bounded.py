"""Limit the size of tables that store state of other nodes."""

from __future__ import annotations

from collections.abc import Hashable
from typing import TypeVar

Key = TypeVar("Key", bound=Hashable)
Value = TypeVar("Value")


def put_bounded(table: dict[Key, Value], key: Key, value: Value, most: int) -> None:
    """Put ``value`` at the end of a table; if the table then has more than ``most`` entries, delete the first."""
    table.pop(key, None)
    table[key] = value
    if len(table) > most:
        del table[next(iter(table))]
