"""The workload of groups: as that of tasks, with tasks that are divided together, and E8: no agent acts on two."""

from __future__ import annotations

from dataclasses import replace

from agents.state import State
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

    def watch(self) -> None:
        """Look at every agent, and on how many tasks it acts or may act."""
        super().watch()
        for place, agent in sorted(self.agents.items()):
            engagements = {name: part.engagement for name, part in agent._parts.items()}
            acting = [name for name, each in engagements.items() if each.course.state is State.EXECUTING]
            lessees = {name: each.lessee for name, each in engagements.items() if each.lessee is not None}
            holding = [name for name, lessee in lessees.items() if lessee.lease is not None]
            if len(acting) > 1 or len(holding) > 1:
                self.say(f"E8: dog{place} acts on {acting} and holds the leases of {holding}")
