"""Floor: the link of the figures in ``docs/consensus.md``: one way 20 ms and an exponential 10 ms, loss by chance."""

from __future__ import annotations

import random
from collections.abc import Sequence

from middleware.entangled.network.network import Address

DELAY, JITTER = 0.02, 0.01


class Floor:
    """A ``switchboard.Link`` between any two nodes; ``loss`` is the share of datagrams that is lost, each way."""

    def __init__(self, loss: float) -> None:
        self._loss = loss

    def delays(self, source: Address, to: Address, size: int, now: float, rng: random.Random) -> Sequence[float]:
        """The seconds that a datagram takes; none where it is lost."""
        if rng.random() < self._loss:
            return ()
        return (DELAY + rng.expovariate(1.0 / JITTER),)
