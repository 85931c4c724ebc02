"""Run: one schedule with the workloads that its seed draws, in this process or in several."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Protocol

from sim.team.files import DiskFleet
from sim.team.schedule import Schedule
from sim.team.shrink import WHOLE, Trim, shrunk
from sim.team.sweep import sweep
from sim.team.workload import Workload
from sim.team.world import Fleet
from tests.invariants.bug import BUGS, FINDERS, seeded
from tests.invariants.deciders import Deciders
from tests.invariants.leases import Leases
from tests.invariants.records import Records
from tests.invariants.stores import Stores
from tests.invariants.tasks import Groups, Tasks
from tests.invariants.tuples import Tuples
from tests.invariants.wire import Wire


class Alone(Protocol):
    """A workload with a world and faults of its own, which last so many ``seconds``."""

    seconds: float

    @property
    def faults(self) -> Sequence[object]:
        """What happens, or has happened, to it."""

    @property
    def digest(self) -> str:
        """A hash of what happened."""

    def run(self) -> list[str]:
        """Every violation, a line each."""


WORKLOADS: dict[str, Callable[[Schedule], Workload]] = {
    "records": Records,
    "tuples": Tuples,
    "stores": Stores,
    "wire": Wire,
    "deciders": Deciders,
}
"""Each may be asked for by name; the order is the one in which they act."""
ALONE: dict[str, Callable[[int, Trim], Alone]] = {"tasks": Tasks, "leases": Leases, "groups": Groups}
"""Those that need no fleet: a world of their own beside it, with faults of its own."""
SHARES = {"records": 0.15, "tuples": 0.06, "stores": 0.06, "wire": 0.06, "deciders": 0.06, "groups": 0.06}
"""The share of schedules in which each takes part, unless it is asked for; those that are not here are in all."""


@dataclass(frozen=True)
class Outcome:
    """What came of one schedule: its ``title``, the ``found`` violations, and the hash of every datagram in it.

    ``names`` are its workloads, ``faults`` how many there were in the world that had most, ``seconds`` how long they
    went on in the one where that was longest.
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
        """The workloads of each of its worlds, which know nothing of each other."""
        alone = [(name,) for name in self.names if name in ALONE]
        together = tuple(name for name in self.names if name in WORKLOADS)
        return [*alone, together] if together else [*alone]


def drawn(seed: int) -> list[str]:
    """The workloads of a seed."""
    dice = random.Random(f"workloads/{seed}")
    return [
        *(name for name, share in SHARES.items() if dice.random() < share),
        *(name for name in ALONE if name not in SHARES),
    ]


def run(seed: int, only: tuple[str, ...] = (), bug: str | None = None, trim: Trim = WHOLE) -> Outcome:
    """Run the schedule of ``seed``, with the workloads of ``only`` instead of those drawn, and with a bug put in.

    ``trim`` says what is left of it; the workloads that it names are meant, whatever ``only`` says.
    """
    names = tuple(trim.only or only or drawn(seed))
    with seeded(bug):
        alone = [ALONE[name](seed, trim) for name in ALONE if name in names]
        found = [line for world in alone for line in world.run()]
        worlds: list[Alone | Schedule] = [*alone]
        if len(names) > len(alone):
            schedule = Schedule(seed, DiskFleet if "stores" in names else Fleet, trim)
            found += schedule.run([WORKLOADS[name](schedule) for name in WORKLOADS if name in names])
            worlds.append(schedule)
            faults = "; ".join(map(str, schedule.faults))
            title = f"n={schedule.n} {'+'.join(names)} {schedule.weather} faults: {faults}"
            digest = schedule.fleet.board.digest()
        else:
            title, digest = "; ".join(map(str, alone)), " ".join(world.digest for world in alone)
    most = max(len(world.faults) for world in worlds)
    return Outcome(seed, title, found, digest, names, most, max(world.seconds for world in worlds))


def run_all(
    seeds: Sequence[int],
    jobs: int,
    only: tuple[str, ...] = (),
    bug: str | None = None,
    trim: Trim = WHOLE,
    scheduler: str = "",
) -> Iterator[Outcome]:
    """Run many, ``jobs`` at a time or on the workers of a ``scheduler``; what came of each, in the order of seeds."""
    return sweep(seeds, partial(run, only=only, bug=bug, trim=trim), jobs, scheduler)


Hunted = tuple[str, tuple[str, ...], int, Outcome | None]
"""A bug, the workloads that looked for it, how many schedules they took, and the one that showed it, if any did."""


def hunt(number: int, seeds: Sequence[int]) -> Hunted:
    """Look for the bug of this number, one schedule after the other."""
    bug = list(BUGS)[number]
    only = FINDERS[bug]
    for needed, seed in enumerate(seeds, start=1):
        outcome = run(seed, only, bug)
        if outcome.found:
            return bug, only, needed, outcome
    return bug, only, len(seeds), None


def hunt_all(seeds: Sequence[int], jobs: int, scheduler: str = "") -> Iterator[Hunted]:
    """Look for every bug, several at a time; what came of each in the order in which they are listed."""
    return sweep(range(len(BUGS)), partial(hunt, seeds=seeds), jobs, scheduler)


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
