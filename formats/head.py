"""Read and write the head of an HTTP/1.1 request or response (RFC 9112), for example before a protocol upgrade."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

MAX_HEAD_BYTES = 8192
"""The maximum number of bytes of a head."""
_HEAD_END = b"\r\n\r\n"


class Head(NamedTuple):
    """``first`` is the request or status line, ``fields`` the header fields by their lower-case names."""

    first: bytes
    fields: Mapping[bytes, bytes]

    @property
    def summary(self) -> str:
        """The start of the first line, for error messages."""
        return self.first[:60].decode("ascii", "replace")


def encode_head(*lines: str) -> bytes:
    """Encode a head."""
    return "\r\n".join(lines).encode() + _HEAD_END


def pop_head(buffer: bytearray) -> Head | None:
    """Remove the head from ``buffer`` and return the head; None if it is incomplete."""
    end = buffer.find(_HEAD_END, 0, MAX_HEAD_BYTES)
    if end < 0:
        return None
    first, *rest = bytes(buffer[:end]).split(b"\r\n")
    del buffer[: end + len(_HEAD_END)]
    fields: dict[bytes, bytes] = {}
    for line in rest:
        name, _, value = line.partition(b":")
        fields[name.strip().lower()] = value.strip()
    return Head(first, fields)
