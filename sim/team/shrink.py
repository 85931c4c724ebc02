"""Shrink: the least of a failing run that still fails in the same way: fewest faults, calm, fewest workloads, shortest.

It knows no run: it is told how many faults there were, and whether what is left of a run still fails.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

Fails = Callable[["Trim"], bool]

SHARES = (0.125, 0.25, 0.5, 0.75)
"""The shares of its length to which a run is cut, the shortest first."""


@dataclass(frozen=True)
class Trim:
    """What is left of a run.

    ``keep`` are the numbers of the faults that happen (None: all), ``calm`` takes the weather away, ``only`` are the
    workloads (none named: those of the seed), and faults and workloads end after ``seconds`` (None: as drawn).
    """

    keep: tuple[int, ...] | None = None
    calm: bool = False
    only: tuple[str, ...] = ()
    seconds: float | None = None

    def keeps(self, number: int) -> bool:
        """Whether a fault happens."""
        return self.keep is None or number in self.keep

    def within(self, seconds: float) -> float:
        """How long a run lasts that was to last so many ``seconds``."""
        return seconds if self.seconds is None else min(seconds, self.seconds)


WHOLE = Trim()


def shrunk(whole: Trim, faults: int, workloads: Sequence[str], seconds: float, fails: Fails) -> Trim:
    """The least that fails, of a run with so many ``faults`` which lasts ``seconds``.

    First the faults are dropped, then the weather, the workloads, and time.  ``fails`` may begin to say False, where
    there is no more time to try: then it stays at what failed last.
    """
    kept = fewest(range(faults) if whole.keep is None else whole.keep, lambda keep: fails(replace(whole, keep=keep)))
    left = replace(whole, keep=kept)
    if not left.calm and fails(calm := replace(left, calm=True)):
        left = calm
    names = fewest([*range(len(workloads))], lambda some: bool(some) and fails(_with(left, workloads, some)))
    left = _with(left, workloads, names) if len(names) < len(workloads) else left
    for share in SHARES:
        if fails(shorter := replace(left, seconds=left.within(seconds) * share)):
            return shorter
    return left


def _with(trim: Trim, workloads: Sequence[str], numbers: Sequence[int]) -> Trim:
    return replace(trim, only=tuple(workloads[number] for number in numbers))


def fewest(numbers: Sequence[int], fails: Callable[[tuple[int, ...]], bool]) -> tuple[int, ...]:
    """So few of ``numbers`` that without any one of them it no longer fails (Zeller and Hildebrandt's ddmin, 2002).

    Halves are dropped first, then ever smaller parts; the empty set is tried before all.
    """
    kept, parts = tuple(numbers), 2
    if not kept or fails(()):
        return ()
    while len(kept) > 1:
        parts = min(parts, len(kept))
        edges = [len(kept) * part // parts for part in range(parts + 1)]
        for first, last in zip(edges, edges[1:], strict=False):
            rest = kept[:first] + kept[last:]
            if fails(rest):
                kept, parts = rest, max(parts - 1, 2)
                break
        else:
            if parts == len(kept):
                break
            parts *= 2
    return kept
