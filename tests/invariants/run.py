"""Run one schedule, or several in parallel, with the workloads that the seed selects."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Protocol

from sim.team.schedule import Schedule
from sim.team.shrinking import NO_REDUCTION, Reduction, reduce_run
from sim.team.simulation import EntangledTeam
from sim.team.sqlite_files import SqliteTeam
from sim.team.sweep import run_seeds
from sim.team.workload import Workload
from tests.invariants.bug import BUGS, FINDERS, seeded
from tests.invariants.deciders import Deciders
from tests.invariants.leases import Leases
from tests.invariants.records import Records
from tests.invariants.stores import Stores
from tests.invariants.tasks import Groups, Tasks
from tests.invariants.tuples import Tuples
from tests.invariants.wire import Wire


class Alone(Protocol):
    """A workload with its own world and its own faults, which last ``seconds``."""

    seconds: float

    @property
    def faults(self) -> Sequence[object]:
        """Return the faults of the workload."""

    @property
    def digest(self) -> str:
        """Return a hash of all events."""

    def run(self) -> list[str]:
        """Run the workload; return one line per violation."""


WORKLOADS: dict[str, Callable[[Schedule], Workload]] = {
    "records": Records,
    "tuples": Tuples,
    "stores": Stores,
    "wire": Wire,
    "deciders": Deciders,
}
"""The workloads that share a world, in the order in which they act."""
ALONE: dict[str, Callable[[int, Reduction], Alone]] = {"tasks": Tasks, "leases": Leases, "groups": Groups}
"""The workloads that have their own world and faults."""
SHARES = {"records": 0.15, "tuples": 0.06, "stores": 0.06, "wire": 0.06, "deciders": 0.06, "groups": 0.06}
"""The share of schedules that contain a workload if it is not requested. All other workloads are in every schedule."""


@dataclass(frozen=True)
class Outcome:
    """The result of one schedule: its ``title``, its violations (``found``), and the hash of all datagrams.

    ``names`` are the schedule's workloads, ``faults`` is the largest number of faults in one of its worlds, and
    ``seconds`` the longest duration of a world.
    """

    seed: int
    title: str
    found: list[str]
    digest: str
    names: tuple[str, ...] = ()
    faults: int = 0
    seconds: float = 0.0

    @property
    def worlds(self) -> list[tuple[str, ...]]:
        """Return the workloads of each independent world."""
        alone = [(name,) for name in self.names if name in ALONE]
        together = tuple(name for name in self.names if name in WORKLOADS)
        return [*alone, together] if together else [*alone]


def drawn(seed: int) -> list[str]:
    """Return the random workloads of a seed."""
    rng = random.Random(f"workloads/{seed}")
    return [
        *(name for name, share in SHARES.items() if rng.random() < share),
        *(name for name in ALONE if name not in SHARES),
    ]


def run(seed: int, only: tuple[str, ...] = (), bug: str | None = None, trim: Reduction = NO_REDUCTION) -> Outcome:
    """Run the schedule of ``seed``, with the workloads ``only`` (if given) and the seeded bug ``bug``.

    ``trim`` is the part of the schedule that remains; its workloads take precedence over ``only``.
    """
    names = tuple(trim.only or only or drawn(seed))
    with seeded(bug):
        alone = [ALONE[name](seed, trim) for name in ALONE if name in names]
        found = [line for world in alone for line in world.run()]
        worlds: list[Alone | Schedule] = [*alone]
        if len(names) > len(alone):
            schedule = Schedule(seed, SqliteTeam if "stores" in names else EntangledTeam, trim)
            found += schedule.run([WORKLOADS[name](schedule) for name in WORKLOADS if name in names])
            worlds.append(schedule)
            faults = "; ".join(map(str, schedule.faults))
            title = f"n={schedule.n} {'+'.join(names)} {schedule.conditions} faults: {faults}"
            digest = schedule.team.switchboard.digest()
        else:
            title, digest = "; ".join(map(str, alone)), " ".join(world.digest for world in alone)
    most = max(len(world.faults) for world in worlds)
    return Outcome(seed, title, found, digest, names, most, max(world.seconds for world in worlds))


def run_all(
    seeds: Sequence[int],
    jobs: int,
    only: tuple[str, ...] = (),
    bug: str | None = None,
    trim: Reduction = NO_REDUCTION,
    scheduler: str = "",
) -> Iterator[Outcome]:
    """Run many schedules, ``jobs`` in parallel or on the workers of a ``scheduler``; yield outcomes in order."""
    return run_seeds(seeds, partial(run, only=only, bug=bug, trim=trim), jobs, scheduler)


Hunted = tuple[str, tuple[str, ...], int, Outcome | None]
"""A bug, its workloads, the number of schedules run, and the outcome that detected it, or None."""


def hunt(number: int, seeds: Sequence[int]) -> Hunted:
    """Run one schedule after the other until one detects the bug with this number."""
    bug = list(BUGS)[number]
    only = FINDERS[bug]
    for needed, seed in enumerate(seeds, start=1):
        outcome = run(seed, only, bug)
        if outcome.found:
            return bug, only, needed, outcome
    return bug, only, len(seeds), None


def hunt_all(seeds: Sequence[int], jobs: int, scheduler: str = "") -> Iterator[Hunted]:
    """Look for all bugs in parallel; yield the results in the order of the bugs."""
    return run_seeds(range(len(BUGS)), partial(hunt, seeds=seeds), jobs, scheduler)


@dataclass(frozen=True)
class Least:
    """The smallest part of a schedule (``trim``) that still fails, its outcome, and the number of ``runs`` needed."""

    trim: Reduction
    outcome: Outcome
    runs: int


def least(
    outcome: Outcome,
    bug: str | None = None,
    is_over: Callable[[], bool] = lambda: False,
    whole: Reduction = NO_REDUCTION,
) -> Least:
    """Reduce a failed schedule as long as it violates the same invariant, until ``is_over`` returns true.

    ``whole`` is the part of the schedule that the failed run executed.
    """
    invariant = outcome.found[0].partition(":")[0]
    best, runs = Least(replace(whole, only=outcome.names), outcome, 0), 0

    def fails(trim: Reduction) -> bool:
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
        # The worlds are independent, so at least one of them also fails when it runs alone.
        any(fails(replace(whole, only=world)) for world in worlds)
    left = best.outcome
    reduce_run(best.trim, left.faults, left.names if len(left.worlds) == 1 else (), left.seconds, fails)
    return replace(best, runs=runs)


def line(seed: int, trim: Reduction, bug: str | None = None) -> str:
    """Return the command that replays the schedule."""
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
