"""Least: what is left of a schedule that failed, when all is taken away that it does not need to fail so again."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from sim.team.shrink import WHOLE, Trim, shrunk
from tests.invariants.run import Outcome, run


@dataclass(frozen=True)
class Least:
    """The ``trim`` that is left, what came of it, and in how many ``runs`` it was found."""

    trim: Trim
    outcome: Outcome
    runs: int


def least(
    outcome: Outcome, bug: str | None = None, is_over: Callable[[], bool] = lambda: False, whole: Trim = WHOLE
) -> Least:
    """The least of a failed schedule that breaks the same invariant; when ``is_over`` says so it ends with what it has.

    The schedule was ``whole`` before, or what that says was left of it.
    """
    invariant = outcome.found[0].partition(":")[0]
    best, runs = Least(replace(whole, only=outcome.names), outcome, 0), 0

    def fails(trim: Trim) -> bool:
        nonlocal best, runs
        if is_over():
            return False
        runs += 1
        again = run(outcome.seed, (), bug, trim)
        is_same = any(line.startswith(f"{invariant}:") for line in again.found)
        if is_same:
            best = Least(trim, again, runs)
        return is_same

    worlds = outcome.worlds
    if len(worlds) > 1:
        # They know nothing of each other: it is in one of them.
        any(fails(replace(whole, only=world)) for world in worlds)
    left = best.outcome
    shrunk(best.trim, left.faults, left.names if len(left.worlds) == 1 else (), left.seconds, fails)
    return replace(best, runs=runs)


def line(seed: int, trim: Trim, bug: str | None = None) -> str:
    """The command that repeats it."""
    words = ["python -m tests.invariants --schedules 1", f"--seed {seed}"]
    if trim.only:
        words.append(f"--only {','.join(trim.only)}")
    if trim.keep is not None:
        words.append(f"--keep {','.join(map(str, trim.keep)) or 'none'}")
    if trim.calm:
        words.append("--calm")
    if trim.seconds is not None:
        words.append(f"--seconds {trim.seconds:g}")
    if bug:
        words.append(f"--bug {bug!r}")
    return " ".join(words)
