"""Head: of an HTTP/1.1 request or answer (RFC 9112), as far as it is needed to begin a stream of something else."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

MAX_HEAD = 8192
"""Bytes of one; where there are more without an end nobody speaks HTTP."""
_END = b"\r\n\r\n"


class Head(NamedTuple):
    """``first`` is the line with the request or the status, ``fields`` has the others by their names in lower case."""

    first: bytes
    fields: Mapping[bytes, bytes]

    @property
    def said(self) -> str:
        """The beginning of the first line, for people."""
        return self.first[:60].decode("ascii", "replace")


def head(*lines: str) -> bytes:
    """One to send."""
    return "\r\n".join(lines).encode() + _END


def taken(buffer: bytearray) -> Head | None:
    """The one with which ``buffer`` begins, taken out of it; None while its end is not there."""
    end = buffer.find(_END, 0, MAX_HEAD)
    if end < 0:
        return None
    first, *rest = bytes(buffer[:end]).split(b"\r\n")
    del buffer[: end + len(_END)]
    fields: dict[bytes, bytes] = {}
    for line in rest:
        name, _, value = line.partition(b":")
        fields[name.strip().lower()] = value.strip()
    return Head(first, fields)
