"""Radio: a link on which datagrams are lost, late, doubled, and overtake each other (``switchboard.Link``)."""

from __future__ import annotations

import random
from collections.abc import Sequence
from dataclasses import dataclass

from middleware.entangled.network.network import Address
from sim.team.world import PORT


@dataclass(frozen=True)
class Air:
    """How datagrams fare: one-way ``delay`` plus an exponential ``jitter``, in seconds; shares lost and doubled.

    With ``burst`` the losses come in bursts of that mean length (Gilbert and Elliott), in the same number.
    """

    delay: float = 0.002
    jitter: float = 0.001
    loss: float = 0.0
    double: float = 0.0
    burst: float = 1.0


CALM = Air()


class Radio:
    """The link between all places; ``cut`` holds the directed pairs of places that do not hear each other.

    What is on its way when a pair is cut arrives.
    """

    def __init__(self, air: Air = CALM) -> None:
        self._air = self._slowest = air
        self.cut: set[tuple[int, int]] = set()
        self._bad: dict[tuple[Address, Address], bool] = {}

    @property
    def air(self) -> Air:
        """How datagrams fare now."""
        return self._air

    @air.setter
    def air(self, air: Air) -> None:
        self._air = air
        self._slowest = max(self._slowest, air, key=lambda one: one.delay + 10 * one.jitter)

    @property
    def longest_way(self) -> float:
        """Seconds within which a datagram arrives, but for one in twenty thousand."""
        return self._slowest.delay + 10 * self._slowest.jitter

    def delays(self, source: Address, to: Address, size: int, now: float, rng: random.Random) -> Sequence[float]:
        """The seconds that each copy of a datagram takes; none where it is lost."""
        air, is_cut = self._air, (source.port - PORT, to.port - PORT) in self.cut
        copies = 2 if air.double and rng.random() < air.double else 1
        return [
            air.delay + (rng.expovariate(1.0 / air.jitter) if air.jitter else 0.0)
            for _ in range(copies)
            if not is_cut and not self._is_lost(source, to, rng)
        ]

    def _is_lost(self, source: Address, to: Address, rng: random.Random) -> bool:
        loss, burst = self._air.loss, self._air.burst
        if loss == 0.0:
            return False
        if burst <= 1.0:
            return rng.random() < loss
        is_bad = self._bad.get((source, to), False)
        turns = 1.0 / burst if is_bad else loss / (burst * (1.0 - loss))
        self._bad[source, to] = is_bad = is_bad != (rng.random() < turns)
        return is_bad
