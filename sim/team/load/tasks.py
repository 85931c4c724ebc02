"""Workload: many simultaneous tasks; the few agents that sense a task bid (Assumption 1), and one gets the lease.

Each task passes through all phases: council, bids, announcement, claim.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

from msgspec import Meta
from twisted.internet.defer import Deferred

from formats.convert import Unit
from middleware.tasks.task import Task
from sim.team.load.allocation import TaskAllocation
from sim.team.load.bidding_agents import get_bidding_agents
from sim.team.load.client_workload import ClientWorkload
from sim.team.load.lookups import MAX_LISTED
from sim.team.metric import Metric, make_maximum, make_percentiles, make_share
from sim.team.team import Team


@dataclass(frozen=True)
class TaskSettings:
    """``[load.tasks]``: the number of simultaneous tasks."""

    count: Annotated[int, Meta(ge=1, le=100_000)] = 1000
    """Number of tasks published at the same time."""

    bidders: Annotated[int, Meta(ge=1, le=10_000)] = 8
    """Number of agents that bid for each task."""

    waiting: Annotated[float, Meta(ge=0.0, le=60.0), Unit("seconds")] = 0.5
    """Waiting period for bids after the first one, in seconds."""

    ttl: Annotated[float, Meta(ge=0.1, le=60.0), Unit("seconds")] = 1.5
    """Time to live of a lease in seconds."""

    after: Annotated[float, Meta(ge=0.0, le=3600.0), Unit("seconds")] = 2.0
    """Seconds from the first step until the tasks are published."""


class Tasks(ClientWorkload):
    """The workload ``tasks``."""

    def __init__(self, team: Team, settings: TaskSettings) -> None:
        super().__init__(team, "tasks")
        self._settings = settings
        self._agents = get_bidding_agents(team)
        self._due_at: float | None = None
        self._allocations: list[TaskAllocation] = []
        self._counted: list[int] = []
        self._right = 0

    def step(self) -> None:
        """Publish all tasks when they are due."""
        now = self._clock.seconds()
        if self._due_at is None:
            self._due_at = now + self._settings.after
        if now < self._due_at or self._allocations:
            return
        for number in range(1, self._settings.count + 1):
            waiting, ttl = self._settings.waiting, self._settings.ttl
            task = Task(f"task {number}", "none", "nothing", waiting_period=waiting, lease_ttl=ttl)
            places = self._joined.any(self._rng, self._settings.bidders)
            allocation = TaskAllocation(task, self._agents, places, self._clock, self._rng, claims=True)
            self._allocations.append(allocation)
            if allocation.bidders:
                Deferred.fromCoroutine(allocation.begin())

    def make_final_requests(self) -> None:
        """Count the holders of each task, and end the auctions."""
        self._counted = [len(allocation.find_holders()) for allocation in self._allocations]
        self._right = self._count_nearest_holders()
        for allocation in self._allocations:
            allocation.end()

    def find_violations(self) -> list[str]:
        """Return the tasks without a holder, and the tasks held by two agents at the same time (E2)."""
        found = [f"E2: two held {c.task.task_id} at once" for c in self._allocations if c.overlaps]
        found += [
            f"{allocation.task.task_id} is held by {held} agents"
            + (f": {allocation.start_failure}" if allocation.start_failure else "")
            for allocation, held in zip(self._allocations, self._counted, strict=False)
            if held != 1 and allocation.list_present()
        ]
        more = len(found) - MAX_LISTED
        return found[:MAX_LISTED] + ([f"and {more} more tasks"] if more > 0 else [])

    def collect_metrics(self) -> list[Metric]:
        """Return the share of tasks with exactly one holder, and the times until the tasks had a holder."""
        n = len(self._allocations)
        held = self._counted or [len(allocation.find_holders()) for allocation in self._allocations]
        right = self._right if self._counted else self._count_nearest_holders()
        took = [
            allocation.held_at - allocation.waiting_ends_at
            for allocation in self._allocations
            if allocation.held_at != math.inf
        ]
        return [
            make_share("tasks.held_once", sum(count == 1 for count in held), n),
            make_maximum("tasks.overlaps", float(sum(c.overlaps for c in self._allocations)), "leases", 0.0, n=n),
            make_share("tasks.by_the_nearest", right, n),
            *make_percentiles("tasks.seconds", took, "s", (0.5, 0.99)),
        ]

    def _count_nearest_holders(self) -> int:
        """Return the number of tasks held by the nearest living agent."""
        return sum(
            any(b.agent.uuid == allocation.find_best() for b in allocation.find_holders())
            for allocation in self._allocations
        )
