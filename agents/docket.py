"""Docket: the tasks that one agent knows, which of them has its body, and those that are over; pure.

Who has an outcome never starts again, whatever is heard of it later: its tombstone is kept for longer than any lease
lives and any node may be away, and as long as the task is listed.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable

from middleware.entangled.record import TOLERATED_ABSENCE
from middleware.tasks.task import MAX_LEASE_TTL, Task

KEPT = TOLERATED_ABSENCE + MAX_LEASE_TTL
"""Seconds for which the end of a task is remembered at least."""
MOST = 16
"""So many open tasks are followed at a time; the others wait."""


def precedence(task: Task) -> tuple[int, float, str]:
    """The order in which tasks have a body: the highest priority, then the oldest."""
    return -task.priority, task.created, task.task_id


class Docket:
    """The tasks that a body can do."""

    def __init__(self) -> None:
        self._open: dict[str, Task] = {}
        self._tombstones: dict[str, float] = {}

    def is_new(self, task_id: str) -> bool:
        """Whether nothing is known of the task."""
        return task_id not in self._open and task_id not in self._tombstones

    def add(self, task: Task) -> bool:
        """Take in an open task, or one that was changed; False where its end is known."""
        if task.task_id in self._tombstones:
            return False
        self._open[task.task_id] = task
        return True

    def bury(self, task_id: str, now: float) -> None:
        """The task is over, or nothing for this agent."""
        self._open.pop(task_id, None)
        self._tombstones[task_id] = now

    def forget(self, listed: Collection[str], now: float) -> None:
        """Let tombstones go that nobody needs any more."""
        for task_id, buried in list(self._tombstones.items()):
            if task_id not in listed and now - buried > KEPT:
                del self._tombstones[task_id]

    def followed(self) -> list[Task]:
        """The open tasks that are followed now, the first of them the most urgent."""
        return sorted(self._open.values(), key=precedence)[:MOST]

    @property
    def open(self) -> Collection[str]:
        """The ids of all open tasks."""
        return self._open.keys()


def next_task(tasks: Iterable[Task], current: Task | None, may_be_put_aside: bool) -> Task | None:
    """The task of ``tasks`` that is to have the body, which ``current`` (one of them, or None) has now."""
    first = min(tasks, key=precedence, default=None)
    if current is None or first is None or may_be_put_aside and first.priority > current.priority:
        return first
    return first if may_be_put_aside and precedence(first) < precedence(current) else current
