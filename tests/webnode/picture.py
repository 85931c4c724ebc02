"""A minimal JPEG: only the parts that are read without decoding."""

from __future__ import annotations


def jpeg(width: int = 208, height: int = 156) -> bytes:
    """Return an empty picture of this size in pixels."""
    sizes = height.to_bytes(2, "big") + width.to_bytes(2, "big")
    return b"\xff\xd8\xff\xe0\x00\x04ab\xff\xc0\x00\x0b\x08" + sizes + b"\x01\x01\x11\x00\xff\xd9"
