"""Trouble: what happens to the machines and links of a lease schedule."""

from __future__ import annotations

import random
from collections.abc import Sequence
from dataclasses import dataclass

KINDS = (
    "cut", "cut", "one way", "swizzle", "kill", "kill", "wipe", "freeze", "freeze", "suspend", "change", "change",
    "torn change", "leave", "air", "step", "blackout",
)  # fmt: skip


@dataclass(frozen=True)
class Trouble:
    """Something that happens at ``at`` and ends at ``until``."""

    at: float
    until: float
    kind: str
    places: tuple[int, ...]

    def __str__(self) -> str:
        return f"{self.at:.1f}-{self.until:.1f} {self.kind} {','.join(map(str, self.places))}"


def drawn(dice: random.Random, n: int, agents: Sequence[int], has_stores: bool) -> list[Trouble]:
    """The troubles of one schedule of ``n`` places; those of agents come up more often."""
    troubles = []
    for _ in range(dice.choice([1, 2, 3, 3, 4, 6])):
        at = dice.uniform(0.5, 12.0)
        kind = dice.choice(KINDS)
        seconds = dice.choice([0.5, 1.0, 2.0, 2.0, 3.0, 5.0, 10.0])
        count = dice.choice([1, 1, 2, 3]) if kind in ("kill", "wipe", "freeze", "cut") else 1
        places = tuple(dice.sample(range(n), min(count, n - 1)))
        if dice.random() < 0.4:
            places = (dice.choice(agents), *places[1:])
        if kind == "blackout":
            kind, places = "kill", tuple(range(n))
        if kind == "wipe" and has_stores:
            kind = "kill"
        troubles.append(Trouble(at, at + seconds, kind, places))
    return troubles
