"""Read the headers of a JPEG (ITU-T T.81) before the image is decoded.

A few hundred bytes may declare an image of four thousand megapixels, or thousands of scans over the whole image.
``read_size`` rejects images that would take much memory or time to decode, so call it before every decoder.
"""

from __future__ import annotations

MAX_SIDE_PX = 4096
"""The maximum width and height in pixels."""
MAX_DECODED_PX = 2**25
"""The maximum number of pixels in all scans together: two scans of 16 megapixels, or sixteen of 1920 x 1080."""
_START_OF_FRAME = frozenset((0xC0, 0xC1, 0xC2))
"""Baseline, extended and progressive with Huffman coding. Cameras do not send other types, which are slower to
decode."""
_OTHER_FRAMES = frozenset(range(0xC3, 0xD0)) - {0xC4, 0xC8, 0xCC}
_START_OF_SCAN = b"\xff\xda"
_MARKERS_WITHOUT_LENGTH = frozenset((0x01, *range(0xD0, 0xD8)))


def read_size(data: bytes) -> tuple[int, int] | None:
    """Return width and height in pixels of a complete JPEG; None if it is invalid, truncated or beyond the limits."""
    if not data.startswith(b"\xff\xd8") or not data.endswith(b"\xff\xd9"):
        return None
    offset = 2
    while offset + 9 <= len(data) and data[offset] == 0xFF:
        kind = data[offset + 1]
        if kind == 0xFF or kind in _MARKERS_WITHOUT_LENGTH:
            offset += 1 if kind == 0xFF else 2
            continue
        if kind in _START_OF_FRAME:
            height, width = int.from_bytes(data[offset + 5 : offset + 7]), int.from_bytes(data[offset + 7 : offset + 9])
            return (width, height) if _is_within_limits(width, height, data, offset) else None
        length = int.from_bytes(data[offset + 2 : offset + 4])
        if length < 2 or kind in _OTHER_FRAMES or kind in (0xD8, 0xD9, 0xDA):
            return None
        offset += 2 + length
    return None


def _is_within_limits(width: int, height: int, data: bytes, start: int) -> bool:
    if not (0 < width <= MAX_SIDE_PX and 0 < height <= MAX_SIDE_PX):
        return False
    # Coded data does not contain the marker. Other segments may contain its bytes, so the count can only be too high.
    scans = data.count(_START_OF_SCAN, start)
    return width * height * max(1, scans) <= MAX_DECODED_PX
