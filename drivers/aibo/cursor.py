"""Cursor: takes numbers and names from the front of some bytes, or says how many more are needed; pure."""

from __future__ import annotations

import struct

from drivers.errors import BadFrame

MAX_COUNT = 256
MAX_MODEL = 32


class Short(Exception):
    """A packet goes on beyond the bytes at hand: it has at least ``need`` bytes."""

    def __init__(self, need: int) -> None:
        super().__init__(need)
        self.need = need


def string(text: str) -> bytes:
    """A string as the dog saves one: its length, its bytes and a NUL."""
    data = text.encode("latin-1")
    return struct.pack("<I", len(data)) + data + b"\0"


class Cursor:
    """Takes fields from the front of ``data``; raises ``Short`` at its end, ``BadFrame`` for what cannot be."""

    def __init__(self, data: bytes) -> None:
        self.at = 0
        self._data = data

    def take(self, size: int) -> bytes:
        """So many bytes."""
        piece = self._data[self.at : self.at + size]
        if len(piece) < size:
            raise Short(self.at + size)
        self.at += size
        return piece

    def words(self, count: int) -> tuple[int, ...]:
        """So many unsigned numbers."""
        return struct.unpack(f"<{count}I", self.take(4 * count))

    def floats(self, count: int) -> tuple[float, ...]:
        """So many floats."""
        return struct.unpack(f"<{count}f", self.take(4 * count))

    def count(self) -> int:
        """How many follow."""
        (count,) = self.words(1)
        if count > MAX_COUNT:
            raise BadFrame(f"{count} values in a row are more than any dog has")
        return count

    def row(self) -> tuple[float, ...]:
        """A count, and so many floats."""
        return self.floats(self.count())

    def until_nul(self) -> str:
        """A short name that ends with a NUL."""
        end = self._data.find(b"\0", self.at, self.at + MAX_MODEL)
        if end < 0:
            if len(self._data) - self.at >= MAX_MODEL:
                raise BadFrame("a name without its end")
            raise Short(len(self._data) + 1)
        text = self._data[self.at : end]
        self.at = end + 1
        return text.decode("latin-1")

    def string(self, limit: int) -> str:
        """A string of at most ``limit`` bytes, as ``string`` makes them."""
        (length,) = self.words(1)
        if length > limit:
            raise BadFrame(f"a name of {length} bytes")
        data = self.take(length + 1)
        if data[-1]:
            raise BadFrame("a name without its end")
        return data[:-1].decode("latin-1")
