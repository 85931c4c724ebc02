"""Assign the open tasks of a group jointly to the agents that can do them; pure.

Each agent computes the assignment of the whole group from the reports on all its tasks, and takes the decision for each
task from it. The digest of a decision therefore covers the reports on all these tasks. An acting agent is considered
only for its own task, at a cost reduced by the task's hysteresis. So a task of a group is reassigned under the same
condition as a task without a group.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

from middleware.consensus.assignment import Item
from middleware.consensus.guarded_strategy import GuardedStrategy
from middleware.consensus.report_view import make_view
from middleware.consensus.strategy import Consensus, Report, digest_of
from middleware.directory.presence import EXECUTING
from middleware.tasks.task import Member, Task

GROUP_SETTLE_S = 1.0
"""Seconds without a new task before a group's tasks are assigned, because tasks are submitted one after another."""

GroupKey = tuple[str, str, str]
GetMembers = Callable[[float], Sequence[Member]]
"""Returns the members of a task, including the agent itself, with their valid reports at a time."""


def get_group_key(task: Task) -> GroupKey | None:
    """Return the key of the tasks that are assigned jointly with ``task``; None for a task without a group.

    The key contains the group, the strategy and the requirements. So every agent that takes part in one of these tasks
    takes part in all of them, and receives all their reports.
    """
    if not task.group:
        return None
    requirements = {name: sorted(properties.items()) for name, properties in task.requirements.items()}
    return task.group, task.strategy, repr(sorted(requirements.items()))


class TaskGroup:
    """The tasks of one group as one agent knows them."""

    def __init__(self, strategy: GuardedStrategy) -> None:
        self.strategy = strategy
        self._tasks: dict[str, tuple[Task, GetMembers]] = {}
        self._last_joined_at = -math.inf
        self._inputs: tuple[object, ...] = ()
        self._decisions: Mapping[str, Consensus] = {}

    def join(self, task: Task, members: GetMembers, now: float) -> None:
        """Add ``task`` to the group; ``members`` returns its members."""
        if task.task_id not in self._tasks:
            self._last_joined_at = now
        self._tasks[task.task_id] = task, members

    def leave(self, task_id: str) -> None:
        """Remove a task that is over or paused."""
        self._tasks.pop(task_id, None)

    def make_strategy(self, task: Task, now: float, since: float | None) -> GroupStrategy:
        """Return a strategy for ``task`` that assigns it jointly with the other tasks of the group.

        ``since`` is the number of seconds since the task's first report, None without reports.
        """
        view = make_view(self.strategy)
        members = {name: list(known(now)) for name, (_, known) in sorted(self._tasks.items())}
        acting = {m.uuid: name for name, task_members in members.items() for m in task_members if m.status == EXECUTING}
        reports: list[Report] = []
        missing: set[str] = set()
        for name, task_members in members.items():
            rest = [m for m in task_members if acting.get(m.uuid, name) == name]
            has_acting = any(m.uuid in acting for m in rest)
            for member in rest:
                report = view.make_report(member)
                if report is not None:
                    reports.append(replace(report, task=name))
                elif member.available and not has_acting:
                    missing.add(member.name)
        is_early = since is None or since < task.waiting_period
        why = ""
        if now - self._last_joined_at < GROUP_SETTLE_S:
            why = "waiting for the rest of the group"
        elif missing and is_early:
            why = f"waiting for {', '.join(sorted(missing))}"
        return GroupStrategy(self, task.task_id, tuple(reports), acting, why)

    def decide_all(self, reports: tuple[Report, ...], acting: Mapping[str, str]) -> Mapping[str, Consensus]:
        """Return the decision of each task."""
        counted = tuple(
            self._discount(report) if acting.get(report.agent) == report.task else report for report in reports
        )
        items = tuple(sorted(self._tasks))
        if (reports, counted, items) != self._inputs:
            points = self.strategy.find_group(counted, [Item(name) for name in items])
            digest = digest_of(reports)
            self._decisions = {point.task: replace(point, digest=digest) for point in points}
            self._inputs = reports, counted, items
        return self._decisions

    def _discount(self, report: Report) -> Report:
        """Reduce the cost of an acting agent's report by the hysteresis."""
        task, _ = self._tasks[report.task]
        return replace(report, cost=report.cost * max(0.0, 1.0 - task.hysteresis))


class GroupStrategy:
    """The strategy of a group, restricted to one of its tasks: the interface that ``decide`` uses.

    ``basis`` contains the inputs besides the reports on this task; ``why`` is the reason why no agent is assigned yet,
    or "".
    """

    def __init__(
        self, task_group: TaskGroup, task_id: str, reports: tuple[Report, ...], acting: Mapping[str, str], why: str
    ) -> None:
        strategy = task_group.strategy
        self.name, self.version, self.reads = strategy.name, strategy.version, strategy.reads
        self.improves, self.merge = strategy.improves, strategy.merge
        self.basis: tuple[object, ...] = (task_id, reports, tuple(sorted(acting.items())), why)
        self._task_group = task_group
        self._task_id = task_id
        self._reports = reports
        self._acting = acting
        self._why = why

    def find(self, contacts: Sequence[Report]) -> Consensus:
        """Decide the task jointly with its group."""
        if self._why:
            acting = sorted((r.cost, r.agent) for r in contacts if self._acting.get(r.agent) == self._task_id)
            holder = acting[0][1] if acting else None
            digest = digest_of(self._reports) if acting else ""
            return Consensus(holder, (), digest, self._task_id, strategy=self.name, reason=self._why)
        found = self._task_group.decide_all(self._reports, self._acting).get(self._task_id)
        return found or Consensus(None, strategy=self.name, reason="the task has left its group")
