"""The workload of groups: as that of tasks, with tasks divided together, and the leases that agents hold (E8)."""

from __future__ import annotations

from dataclasses import replace

from agents.loop import Agent
from tests.invariants.tasks import Tasks


class Groups(Tasks):
    """One schedule: agents, tasks in groups, and faults from ``seed``."""

    def submit(self) -> None:
        """One to three tasks, most of them of one group; all of a schedule are divided by one strategy."""
        rng = self.rng
        strategy = ("group_optimal", "cbba", "nearest")[self.n % 3]
        for _ in range(rng.choice([1, 2, 3])):
            task = self.any_task()
            self.enter(replace(task, strategy=strategy, group=rng.choice(["g", "g", "g", ""])))

    def holding(self, agent: Agent) -> tuple[str, ...]:
        """The tasks whose leases an agent holds."""
        lessees = {name: part.engagement.lessee for name, part in agent._parts.items()}
        return tuple(name for name, lessee in lessees.items() if lessee is not None and lessee.lease is not None)
