"""Order faults with a start and an end by the times at which they are due."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from sim.team.shrinking import Reduction


@dataclass(frozen=True)
class TimedFault:
    """A fault of ``kind`` that affects ``places`` from ``at`` to ``until``, in seconds since the schedule's start."""

    at: float
    until: float
    kind: str
    places: tuple[int, ...]

    def __str__(self) -> str:
        return f"{self.at:.1f}-{self.until:.1f} {self.kind} {','.join(map(str, self.places))}"


class Timeline:
    """The starts and ends of the ``faults`` that ``trim`` keeps; at equal times starts come first."""

    def __init__(self, faults: Sequence[TimedFault], trim: Reduction) -> None:
        kept = [(number, fault) for number, fault in enumerate(faults) if trim.keeps(number)]
        ends = [(fault.until, True, number, fault) for number, fault in kept]
        self._pending = sorted(
            [(fault.at, False, number, fault) for number, fault in kept] + ends, key=lambda one: one[:3]
        )

    def pop_due(self, now: float) -> Iterator[tuple[TimedFault, bool]]:
        """Yield each fault that has started (False) or ended (True) by ``now``, each only once."""
        while self._pending and self._pending[0][0] <= now:
            _, is_end, _, fault = self._pending.pop(0)
            yield fault, is_end
