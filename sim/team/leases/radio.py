"""Radio: a light simulated link between machines; datagrams are lost, late, doubled, and overtake each other."""

from __future__ import annotations

import hashlib
import random
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from middleware.entangled.clock import HeapClock


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
    """Carries calls between places; ``cut`` holds the directed pairs that do not hear each other."""

    def __init__(self, clock: HeapClock, rng: random.Random, air: Air = CALM) -> None:
        self._air = self._slowest = air
        self.cut: set[tuple[int, int]] = set()
        self.sent = 0
        self._clock = clock
        self._rng = rng
        self._bad: dict[tuple[int, int], bool] = {}
        self._hash = hashlib.blake2b(digest_size=8)

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

    def send(self, source: int, to: int, deliver: Callable[..., object], *arguments: Any) -> None:
        """Have ``deliver`` called at the other end, perhaps."""
        self.sent += 1
        self.note(source, to, self._clock.seconds())
        copies = 2 if self.air.double and self._rng.random() < self.air.double else 1
        for _ in range(copies):
            if (source, to) not in self.cut and not self._is_lost(source, to):
                late = self._rng.expovariate(1.0 / self.air.jitter) if self.air.jitter else 0.0
                self._clock.callLater(self.air.delay + late, deliver, *arguments)

    def digest(self) -> str:
        """A hash of everything that was sent."""
        return self._hash.hexdigest()

    def note(self, *facts: object) -> None:
        """Let something count for the digest."""
        self._hash.update(repr(facts).encode())

    def _is_lost(self, source: int, to: int) -> bool:
        loss, burst = self.air.loss, self.air.burst
        if loss == 0.0:
            return False
        if burst <= 1.0:
            return self._rng.random() < loss
        is_bad = self._bad.get((source, to), False)
        turns = 1.0 / burst if is_bad else loss / (burst * (1.0 - loss))
        self._bad[source, to] = is_bad = is_bad != (self._rng.random() < turns)
        return is_bad
