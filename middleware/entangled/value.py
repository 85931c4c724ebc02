"""Decode and check the values of records.

A peer may write any bytes as a value; these functions accept only names, strings and finite numbers, and reject any
other value.
"""

from __future__ import annotations

from typing import Any

import msgpack

from middleware.entangled.errors import TooLarge
from middleware.entangled.record import Record

MAX_VALUE_BYTES = 1000
"""The maximum size in bytes of a value that all devices of the team store; its record fits into one datagram."""
MAX_NUMBER = 2**53
"""The maximum absolute value of a number: up to this value JavaScript represents integers exactly."""


def parse_mapping(record: Record, most: int = MAX_VALUE_BYTES) -> dict[str, Any] | None:
    """Return the mapping in a record's value; None if it is not a mapping or exceeds ``most`` bytes."""
    if record.value is None or len(record.value) > most:
        return None
    try:
        content = msgpack.unpackb(record.value, strict_map_key=True)
    except Exception:  # msgpack raises many types on malformed bytes
        return None
    return content if isinstance(content, dict) else None


def check_size(value: bytes) -> bytes:
    """Return ``value``; raise ``TooLarge`` if it has more than ``MAX_VALUE_BYTES`` bytes."""
    if len(value) > MAX_VALUE_BYTES:
        raise TooLarge(
            f"the value has {len(value)} bytes; all devices store it, so {MAX_VALUE_BYTES} is the limit; shorten it"
        )
    return value


def is_number(value: object) -> bool:
    """Return whether ``value`` is a number of at most ``MAX_NUMBER``, not a boolean, infinity or NaN."""
    return type(value) in (int, float) and -MAX_NUMBER <= value <= MAX_NUMBER  # type: ignore[operator]


def is_natural(value: object) -> bool:
    """Return whether ``value`` is an integer from 0 to ``MAX_NUMBER``."""
    return type(value) is int and 0 <= value <= MAX_NUMBER


def are_capabilities(value: object) -> bool:
    """Return whether ``value`` maps capability names to properties, see ``are_properties``."""
    return isinstance(value, dict) and all(
        isinstance(name, str) and isinstance(properties, dict) and are_properties(properties)
        for name, properties in value.items()
    )


def are_properties(value: object) -> bool:
    """Return whether ``value`` maps names to numbers and strings."""
    return isinstance(value, dict) and all(
        isinstance(name, str) and (isinstance(content, str) or is_number(content)) for name, content in value.items()
    )
