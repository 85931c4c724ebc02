"""Jpeg: how large a picture is, by its header alone; nothing is unpacked here.  Pure."""

from __future__ import annotations

MOST_SIDE = 640
"""Pixels of a side of a phone's picture; a few bytes can claim to be far more, and would be in each viewer's memory."""
_SIZED = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_BARE = frozenset(range(0xD0, 0xD8)) | {0x01}


def size_of(data: bytes) -> tuple[int, int] | None:
    """Width and height in pixels of a whole JPEG picture; None where it is none, or too large."""
    if not (data.startswith(b"\xff\xd8") and data.endswith(b"\xff\xd9")):
        return None
    at = 2
    while at + 9 <= len(data) and data[at] == 0xFF:
        mark = data[at + 1]
        if mark in _BARE or mark == 0xFF:
            at += 1 if mark == 0xFF else 2
            continue
        if mark in _SIZED:
            height, width = int.from_bytes(data[at + 5 : at + 7], "big"), int.from_bytes(data[at + 7 : at + 9], "big")
            return (width, height) if 0 < width <= MOST_SIDE and 0 < height <= MOST_SIDE else None
        at += 2 + max(2, int.from_bytes(data[at + 2 : at + 4], "big"))
    return None
