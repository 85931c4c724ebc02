"""Faults of a byte stream, such as the link of an emulated robot, by switches that tests and people set."""

from __future__ import annotations

import random
from collections.abc import Iterator
from dataclasses import dataclass


@dataclass
class StreamFaults:
    """The switches; ``wire`` says what of some bytes leaves the robot, and when.

    ``drop`` and ``garbage`` are the shares of writes that are lost and spoilt, ``delay`` the seconds that all of them
    take longer; while ``half_open``, the robot hears and says nothing at all, though its link stays up; ``split`` cuts
    each write at random places, as a network may.
    """

    drop: float = 0.0
    garbage: float = 0.0
    delay: float = 0.0
    half_open: bool = False
    split: bool = False

    def wire(self, data: bytes, rng: random.Random) -> Iterator[bytes]:
        """The pieces of ``data`` that leave, in their order; none where it is lost."""
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
