"""Run: one schedule with the workloads that its seed draws, in this process or in several."""

from __future__ import annotations

import gc
import multiprocessing
import random
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Protocol

from tests.fleet import Fleet
from tests.invariants.bug import seeded
from tests.invariants.deciders import Deciders
from tests.invariants.disk import DiskFleet
from tests.invariants.groups import Groups
from tests.invariants.leases import Leases
from tests.invariants.records import Records
from tests.invariants.schedule import Schedule, Workload
from tests.invariants.stores import Stores
from tests.invariants.tasks import Tasks
from tests.invariants.tuples import Tuples
from tests.invariants.wire import Wire


class Alone(Protocol):
    """A workload with a world and faults of its own."""

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
ALONE: dict[str, Callable[[int], Alone]] = {"tasks": Tasks, "leases": Leases, "groups": Groups}
"""Those that need no fleet: a world of their own beside it, with faults of its own."""
SHARES = {"records": 1.0, "tuples": 0.06, "stores": 0.06, "wire": 0.06, "deciders": 0.06, "groups": 0.06}
"""The share of schedules in which each takes part, unless it is asked for; those that are not here are in all."""


@dataclass(frozen=True)
class Outcome:
    """What came of one schedule: its ``title``, the ``found`` violations, and the hash of every datagram in it."""

    seed: int
    title: str
    found: list[str]
    digest: str


def drawn(seed: int) -> list[str]:
    """The workloads of a seed."""
    dice = random.Random(f"workloads/{seed}")
    return [
        *(name for name, share in SHARES.items() if dice.random() < share),
        *(name for name in ALONE if name not in SHARES),
    ]


def run(seed: int, only: tuple[str, ...] = (), bug: str | None = None) -> Outcome:
    """Run the schedule of ``seed``, with the workloads of ``only`` instead of those drawn, and with a bug put in."""
    names = only or drawn(seed)
    with seeded(bug):
        alone = [ALONE[name](seed) for name in ALONE if name in names]
        found_alone = [line for world in alone for line in world.run()]
        if alone and len(names) == len(alone):
            return Outcome(seed, "; ".join(map(str, alone)), found_alone, " ".join(world.digest for world in alone))
        schedule = Schedule(seed, DiskFleet if "stores" in names else Fleet)
        found = schedule.run([WORKLOADS[name](schedule) for name in WORKLOADS if name in names])
    faults = "; ".join(map(str, schedule.faults))
    title = f"n={schedule.n} {'+'.join(names)} {schedule.weather} faults: {faults}"
    return Outcome(seed, title, found_alone + found, schedule.fleet.board.digest())


def run_all(seeds: range, jobs: int, only: tuple[str, ...] = (), bug: str | None = None) -> Iterator[Outcome]:
    """Run many, ``jobs`` at a time, and give what came of each in the order of their seeds."""
    one = partial(run, only=only, bug=bug)
    if jobs == 1 or len(seeds) == 1:
        _spare_the_collector()
        yield from map(one, seeds)
        return
    # Not by forking: this may run in a process that has threads and a reactor's signal handlers, which a fork inherits.
    with multiprocessing.get_context("spawn").Pool(jobs, _spare_the_collector) as pool:
        yield from pool.imap(one, seeds)


def _spare_the_collector() -> None:
    """Look for garbage rarely: a schedule makes much that lives as long as it."""
    gc.freeze()
    gc.set_threshold(200_000, 20, 20)
