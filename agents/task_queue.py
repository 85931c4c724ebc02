"""The tasks that one agent knows: the open ones in order of urgency, and the finished ones; pure.

A task that is over never starts again, even if a late record of the task arrives. Its tombstone is kept longer than any
lease and any tolerated absence of a node, and at least as long as the task is listed.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable

from middleware.entangled.record import TOLERATED_ABSENCE_S
from middleware.tasks.task import MAX_LEASE_TTL_S, Task

TOMBSTONE_TTL_S = TOLERATED_ABSENCE_S + MAX_LEASE_TTL_S
"""Minimum seconds for which the end of a task is remembered."""
MAX_FOLLOWED = 16
"""Maximum number of open tasks in which the agent takes part at the same time; further tasks wait."""


def urgency_key(task: Task) -> tuple[int, float, str]:
    """Return the sort key of urgency: the highest priority first, then the oldest."""
    return -task.priority, task.created, task.task_id


class TaskQueue:
    """The tasks that a robot can do."""

    def __init__(self) -> None:
        self._open: dict[str, Task] = {}
        self._tombstones: dict[str, float] = {}

    def is_new(self, task_id: str) -> bool:
        """Return whether the task is unknown: neither open nor over."""
        return task_id not in self._open and task_id not in self._tombstones

    def add(self, task: Task) -> bool:
        """Add or update an open task; False if the task is over."""
        if task.task_id in self._tombstones:
            return False
        self._open[task.task_id] = task
        return True

    def mark_over(self, task_id: str, now: float) -> None:
        """Record that the task is over, or that this agent cannot do it."""
        self._open.pop(task_id, None)
        self._tombstones[task_id] = now

    def expire_tombstones(self, listed: Collection[str], now: float) -> None:
        """Remove tombstones that are no longer needed."""
        for task_id, buried in list(self._tombstones.items()):
            if task_id not in listed and now - buried > TOMBSTONE_TTL_S:
                del self._tombstones[task_id]

    def list_followed(self) -> list[Task]:
        """Return the open tasks in which the agent takes part now, the most urgent first."""
        return sorted(self._open.values(), key=urgency_key)[:MAX_FOLLOWED]

    @property
    def open_ids(self) -> Collection[str]:
        """The ids of all open tasks."""
        return self._open.keys()


def select_task(tasks: Iterable[Task], current: Task | None, may_be_put_aside: bool) -> Task | None:
    """Return the task that should get the robot; ``current`` (one of ``tasks``, or None) has it now."""
    first = min(tasks, key=urgency_key, default=None)
    if current is None or first is None or may_be_put_aside and first.priority > current.priority:
        return first
    return first if may_be_put_aside and urgency_key(first) < urgency_key(current) else current
