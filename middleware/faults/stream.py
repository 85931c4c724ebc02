"""Faults of a byte stream, for example of the link to an emulated robot; tests or a user set the faults."""

from __future__ import annotations

import random
from collections.abc import Iterator
from dataclasses import dataclass


@dataclass
class StreamFaults:
    """The faults of one stream.

    ``drop`` is the share of writes that are lost, ``garbage`` the share of writes that are corrupted, and ``delay`` is
    in seconds.  ``half_open``: the robot receives and sends nothing, but its link stays open.  ``split``: each write is
    split into chunks of random size, as a network may do.
    """

    drop: float = 0.0
    garbage: float = 0.0
    delay: float = 0.0
    half_open: bool = False
    split: bool = False

    def apply(self, data: bytes, rng: random.Random) -> Iterator[bytes]:
        """Yield the chunks of ``data`` that are sent, in order; nothing if ``data`` is lost."""
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
