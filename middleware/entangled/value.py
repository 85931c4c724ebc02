"""Value: what the values of records may hold, checked before anything is made of them.

Peers may write what they like; whoever reads it gets names, texts and finite numbers, or nothing.
"""

from __future__ import annotations

from typing import Any

import msgpack

from middleware.entangled.errors import TooLarge
from middleware.entangled.record import Record

MAX_VALUE = 1000
"""Bytes in a value that every device of the team holds: its record fits into one datagram."""
LARGEST = 2**53
"""No number of ours is larger: up to here every reader of the page's JSON keeps them exact."""


def mapping_of(record: Record, most: int = MAX_VALUE) -> dict[str, Any] | None:
    """The mapping in a record's value, or None where there is none or it has over ``most`` bytes; never raises."""
    if record.value is None or len(record.value) > most:
        return None
    try:
        content = msgpack.unpackb(record.value, strict_map_key=True)
    except Exception:  # the decoder raises many kinds on crafted bytes
        return None
    return content if isinstance(content, dict) else None


def bounded(value: bytes) -> bytes:
    """The same value, where every device of the team can hold it; else raises ``TooLarge``."""
    if len(value) > MAX_VALUE:
        raise TooLarge(f"{len(value)} bytes; what the whole team holds has at most {MAX_VALUE}: shorten the texts")
    return value


def is_number(value: object) -> bool:
    """Whether ``value`` is a finite number that people can be shown; True and False are none."""
    return type(value) in (int, float) and -LARGEST <= value <= LARGEST  # type: ignore[operator]


def is_whole(value: object) -> bool:
    """Whether ``value`` is a whole number from 0 on."""
    return type(value) is int and 0 <= value <= LARGEST


def are_capabilities(value: object) -> bool:
    """Whether ``value`` maps names to properties, and each of these its name to a number or a text."""
    return isinstance(value, dict) and all(
        isinstance(name, str) and isinstance(properties, dict) and are_properties(properties)
        for name, properties in value.items()
    )


def are_properties(value: object) -> bool:
    """Whether ``value`` maps names to numbers and texts."""
    return isinstance(value, dict) and all(
        isinstance(name, str) and (isinstance(content, str) or is_number(content)) for name, content in value.items()
    )
