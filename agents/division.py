"""Division: the open tasks of one group, divided together among those that can do them; pure.

Each agent divides them for itself, out of what all have reported on all of them, and takes from that who is to act in
each task.  So the digest of a decision is that of all these reports, not only of those on its own task.  Whoever acts
already is counted for its task alone, and cheaper by the task's hysteresis, so that a task changes hands here exactly
where it would by itself.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

from middleware.consensus.guard import Guard
from middleware.consensus.item import Item
from middleware.consensus.strategy import Consensus, Report, digest_of
from middleware.consensus.view import view_of
from middleware.directory.presence import EXECUTING
from middleware.tasks.task import Member, Task

GATHERING = 1.0
"""Seconds for which no task may have come to a group before it is divided: they are submitted one after the other."""

Key = tuple[str, str, str]
Members = Callable[[float], Sequence[Member]]
"""Who takes part in a task with what counts at a moment, oneself included."""


def group_of(task: Task) -> Key | None:
    """What tasks have in common that are divided together; None for a task by itself.

    Beside the group that is the strategy, and the requirements: so whoever takes part in one takes part in all, and
    knows what is reported on all of them.
    """
    if not task.group:
        return None
    requirements = {name: sorted(properties.items()) for name, properties in task.requirements.items()}
    return task.group, task.strategy, repr(sorted(requirements.items()))


class Division:
    """The tasks of one group as one agent knows them, and their ``strategy``."""

    def __init__(self, strategy: Guard) -> None:
        self.strategy = strategy
        self._tasks: dict[str, tuple[Task, Members]] = {}
        self._came_at = -math.inf
        self._known: tuple[object, ...] = ()
        self._points: Mapping[str, Consensus] = {}

    def join(self, task: Task, members: Members, now: float) -> None:
        """Divide ``task`` with the others."""
        if task.task_id not in self._tasks:
            self._came_at = now
        self._tasks[task.task_id] = task, members

    def leave(self, task_id: str) -> None:
        """Divide it no more: it is over, or rests."""
        self._tasks.pop(task_id, None)

    def share(self, task: Task, now: float, since: float | None) -> Share:
        """How the strategy sees ``task``, whose first report came ``since`` seconds ago, among the others."""
        view = view_of(self.strategy)
        members = {name: list(known(now)) for name, (_, known) in sorted(self._tasks.items())}
        acting = {m.uuid: name for name, here in members.items() for m in here if m.status == EXECUTING}
        reports: list[Report] = []
        missing: set[str] = set()
        for name, here in members.items():
            rest = [m for m in here if acting.get(m.uuid, name) == name]
            held = any(m.uuid in acting for m in rest)
            for member in rest:
                report = view.report(member)
                if report is not None:
                    reports.append(replace(report, task=name))
                elif member.available and not held:
                    missing.add(member.name)
        is_early = since is None or since < task.waiting_period
        why = ""
        if now - self._came_at < GATHERING:
            why = "waiting for the rest of the group"
        elif missing and is_early:
            why = f"waiting for {', '.join(sorted(missing))}"
        return Share(self, task.task_id, tuple(reports), acting, why)

    def divided(self, reports: tuple[Report, ...], acting: Mapping[str, str]) -> Mapping[str, Consensus]:
        """The consensus point of each task."""
        counted = tuple(self._kept(report) if acting.get(report.agent) == report.task else report for report in reports)
        items = tuple(sorted(self._tasks))
        if (reports, counted, items) != self._known:
            points = self.strategy.find_group(counted, [Item(name) for name in items])
            digest = digest_of(reports)
            self._points = {point.task: replace(point, digest=digest) for point in points}
            self._known = reports, counted, items
        return self._points

    def _kept(self, report: Report) -> Report:
        """The report of who acts: another has to be better than this."""
        task, _ = self._tasks[report.task]
        return replace(report, cost=report.cost * max(0.0, 1.0 - task.hysteresis))


class Share:
    """The strategy of a group, asked about one of its tasks: a strategy as a decision knows it.

    ``basis`` is what it goes by beside the reports on its own task; ``why`` says why nobody is named yet, if so.
    """

    def __init__(
        self, division: Division, task_id: str, reports: tuple[Report, ...], acting: Mapping[str, str], why: str
    ) -> None:
        strategy = division.strategy
        self.name, self.version, self.reads = strategy.name, strategy.version, strategy.reads
        self.improves, self.merge = strategy.improves, strategy.merge
        self.basis: tuple[object, ...] = (task_id, reports, tuple(sorted(acting.items())), why)
        self._division = division
        self._task_id = task_id
        self._reports = reports
        self._acting = acting
        self._why = why

    def find(self, contacts: Sequence[Report]) -> Consensus:
        """The consensus point of its task, where all are divided."""
        if self._why:
            acting = sorted((r.cost, r.agent) for r in contacts if self._acting.get(r.agent) == self._task_id)
            holder = acting[0][1] if acting else None
            digest = digest_of(self._reports) if acting else ""
            return Consensus(holder, (), digest, self._task_id, strategy=self.name, reason=self._why)
        found = self._division.divided(self._reports, self._acting).get(self._task_id)
        return found or Consensus(None, strategy=self.name, reason="the task has left its group")
