"""A radio link with losses, delays, duplicates and reordering (``switchboard.LinkModel``)."""

from __future__ import annotations

import random
from collections.abc import Sequence
from dataclasses import dataclass

from middleware.entangled.network.network import Address
from sim.team.simulation import FIRST_PORT


@dataclass(frozen=True)
class LinkQuality:
    """The quality of a radio link: one-way ``delay`` plus exponential ``jitter`` (s), shares of loss and duplicates.

    With ``burst``, losses occur at the same rate, but in bursts of this mean length (Gilbert-Elliott).
    """

    delay: float = 0.002
    jitter: float = 0.001
    loss: float = 0.0
    duplicate: float = 0.0
    burst: float = 1.0


DEFAULT_QUALITY = LinkQuality()


class RadioLink:
    """The link between all places; ``cut`` contains the directed pairs of places that are disconnected.

    Datagrams that are in flight when a pair is cut still arrive.
    """

    def __init__(self, air: LinkQuality = DEFAULT_QUALITY) -> None:
        self._quality = self._slowest = air
        self.cut: set[tuple[int, int]] = set()
        self._bad: dict[tuple[Address, Address], bool] = {}

    @property
    def quality(self) -> LinkQuality:
        """The current quality."""
        return self._quality

    @quality.setter
    def quality(self, air: LinkQuality) -> None:
        self._quality = air
        self._slowest = max(self._slowest, air, key=lambda one: one.delay + 10 * one.jitter)

    @property
    def max_delay(self) -> float:
        """The delay in seconds that only one in twenty thousand datagrams exceeds."""
        return self._slowest.delay + 10 * self._slowest.jitter

    def draw_delays(self, source: Address, to: Address, size: int, now: float, rng: random.Random) -> Sequence[float]:
        """Return the delay of each copy of a datagram in seconds; empty if the datagram is lost."""
        air, is_cut = self._quality, (source.port - FIRST_PORT, to.port - FIRST_PORT) in self.cut
        copies = 2 if air.duplicate and rng.random() < air.duplicate else 1
        return [
            air.delay + (rng.expovariate(1.0 / air.jitter) if air.jitter else 0.0)
            for _ in range(copies)
            if not is_cut and not self._is_lost(source, to, rng)
        ]

    def _is_lost(self, source: Address, to: Address, rng: random.Random) -> bool:
        loss, burst = self._quality.loss, self._quality.burst
        if loss == 0.0:
            return False
        if burst <= 1.0:
            return rng.random() < loss
        is_bad = self._bad.get((source, to), False)
        turns = 1.0 / burst if is_bad else loss / (burst * (1.0 - loss))
        self._bad[source, to] = is_bad = is_bad != (rng.random() < turns)
        return is_bad
