"""Faults of a byte stream, such as the link of an emulated robot, set by tests or by hand."""

from __future__ import annotations

import random
from collections.abc import Iterator
from dataclasses import dataclass


@dataclass
class StreamFaults:
    """The faults of one stream.

    ``drop`` and ``garbage`` are the shares of writes that are lost and corrupted, ``delay`` is in seconds.
    ``half_open``: the robot receives and sends nothing, but its link stays open.  ``split``: each write is cut at
    random places, as a network may do.
    """

    drop: float = 0.0
    garbage: float = 0.0
    delay: float = 0.0
    half_open: bool = False
    split: bool = False

    def apply(self, data: bytes, rng: random.Random) -> Iterator[bytes]:
        """Yield the pieces of ``data`` that are sent, in order; none if it is lost."""
        if self.half_open or rng.random() < self.drop:
            return
        if data and rng.random() < self.garbage:
            place = rng.randrange(len(data))
            data = data[:place] + bytes([data[place] ^ rng.randrange(1, 256)]) + data[place + 1 :]
        if not self.split:
            yield data
            return
        while data:
            size = rng.randint(1, len(data))
            yield data[:size]
            data = data[size:]
