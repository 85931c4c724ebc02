"""Shrink a failing run: fewest faults, no network impairments, fewest workloads, shortest duration.

This module does not start runs: the caller provides the number of faults, and determines whether a reduced run fails.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

Fails = Callable[["Reduction"], bool]

DURATION_SHARES = (0.125, 0.25, 0.5, 0.75)
"""The shares of its duration to which a run is shortened, shortest first."""


@dataclass(frozen=True)
class Reduction:
    """A reduction of a run.

    ``keep`` are the indices of the remaining faults (None: all), ``calm`` removes network impairments, ``only`` are
    the remaining workloads (empty: those of the seed). Faults and workloads end after ``seconds`` (None: the duration
    of the seed).
    """

    keep: tuple[int, ...] | None = None
    calm: bool = False
    only: tuple[str, ...] = ()
    seconds: float | None = None

    def keeps(self, number: int) -> bool:
        """Return whether a fault remains."""
        return self.keep is None or number in self.keep

    def limit_duration(self, seconds: float) -> float:
        """Return the reduced duration of a run of ``seconds``."""
        return seconds if self.seconds is None else min(seconds, self.seconds)


NO_REDUCTION = Reduction()


def reduce_run(whole: Reduction, faults: int, workloads: Sequence[str], seconds: float, fails: Fails) -> Reduction:
    """Return the smallest failing reduction of a run with ``faults`` faults that lasts ``seconds``.

    Faults are removed first, then network impairments and workloads, and then the duration is reduced. ``fails`` may
    return False when its time budget is used up; the result is then the last reduction that failed.
    """
    kept = minimize(range(faults) if whole.keep is None else whole.keep, lambda keep: fails(replace(whole, keep=keep)))
    left = replace(whole, keep=kept)
    if not left.calm and fails(calm := replace(left, calm=True)):
        left = calm
    names = minimize(
        [*range(len(workloads))], lambda some: bool(some) and fails(_keep_workloads(left, workloads, some))
    )
    left = _keep_workloads(left, workloads, names) if len(names) < len(workloads) else left
    for share in DURATION_SHARES:
        if fails(shorter := replace(left, seconds=left.limit_duration(seconds) * share)):
            return shorter
    return left


def _keep_workloads(trim: Reduction, workloads: Sequence[str], numbers: Sequence[int]) -> Reduction:
    return replace(trim, only=tuple(workloads[number] for number in numbers))


def minimize(numbers: Sequence[int], fails: Callable[[tuple[int, ...]], bool]) -> tuple[int, ...]:
    """Return a 1-minimal subset of ``numbers`` that still fails (ddmin, Zeller and Hildebrandt, 2002).

    First the empty set is tried; then halves are removed, then smaller and smaller parts.
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
