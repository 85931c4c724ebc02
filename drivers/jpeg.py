"""Jpeg: what the head of a JPEG tells; nothing is unpacked here."""

from __future__ import annotations

_SIZED = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_BARE = frozenset((0x01, *range(0xD0, 0xD8)))


def size_of(data: bytes) -> tuple[int, int] | None:
    """Width and height in pixels of a whole JPEG; None for anything else, as one that was cut off."""
    if not data.startswith(b"\xff\xd8") or not data.endswith(b"\xff\xd9"):
        return None
    place = 2
    while place + 9 <= len(data) and data[place] == 0xFF:
        kind = data[place + 1]
        if kind == 0xFF or kind in _BARE:
            place += 1 if kind == 0xFF else 2
            continue
        if kind in _SIZED:
            height, width = int.from_bytes(data[place + 5 : place + 7]), int.from_bytes(data[place + 7 : place + 9])
            return (width, height) if width and height else None
        length = int.from_bytes(data[place + 2 : place + 4])
        if length < 2 or kind in (0xD8, 0xD9, 0xDA):
            return None
        place += 2 + length
    return None
