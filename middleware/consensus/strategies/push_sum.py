"""Push-sum: the average without anybody who gathers; each agent gives half of what it has to another, again and again.

Kempe, Dobra, Gehrke 2003.  What was given is kept in mind until it is acknowledged and given again until then, so
nothing is lost with a message and nothing counts twice: the mass of all (value times weight, and weight) stays.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple


class Share(NamedTuple):
    """A half on its way: who gives it, the number of the gift, its ``mass`` (values times weight) and ``weight``."""

    giver: str
    number: int
    mass: tuple[float, ...]
    weight: float


class PushSum:
    """One agent's part; messages are values, the caller sends what ``give`` and ``unacknowledged`` hand out."""

    def __init__(self, agent: str, value: Sequence[float], weight: float = 1.0) -> None:
        self.agent = agent
        self.mass = tuple(v * weight for v in value)
        self.weight = weight
        self._count = 0
        self._given: dict[int, tuple[str, Share]] = {}
        self._taken: dict[str, set[int]] = {}
        self._below: dict[str, int] = {}

    @property
    def value(self) -> tuple[float, ...]:
        """The average as far as it is known here; () once everything was given away."""
        return tuple(m / self.weight for m in self.mass) if self.weight > 0.0 else ()

    def give(self, taker: str, whole: bool = False) -> Share:
        """Half of what there is, for ``taker`` (who leaves gives the ``whole``)."""
        part = 1.0 if whole else 0.5
        self._count += 1
        share = Share(self.agent, self._count, tuple(m * part for m in self.mass), self.weight * part)
        self.mass = tuple(m - s for m, s in zip(self.mass, share.mass, strict=True))
        self.weight -= share.weight
        self._given[share.number] = (taker, share)
        return share

    def take(self, share: Share) -> int:
        """Take a share, once; gives the number to acknowledge."""
        taken = self._taken.setdefault(share.giver, set())
        if not self.has_taken(share) and len(share.mass) == len(self.mass):
            below = self._below.get(share.giver, 0)
            taken.add(share.number)
            while below + 1 in taken:
                below += 1
                taken.remove(below)
            self._below[share.giver] = below
            self.mass = tuple(m + s for m, s in zip(self.mass, share.mass, strict=True))
            self.weight += share.weight
        return share.number

    def has_taken(self, share: Share) -> bool:
        """Whether a share has arrived here."""
        return share.number <= self._below.get(share.giver, 0) or share.number in self._taken.get(share.giver, ())

    def acknowledged(self, number: int) -> None:
        """A share has arrived."""
        self._given.pop(number, None)

    def unacknowledged(self) -> list[tuple[str, Share]]:
        """What is to be sent again, and to whom."""
        return [self._given[number] for number in sorted(self._given)]
