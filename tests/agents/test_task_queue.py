"""Tests of ``agents.task_queue``: the task that controls the robot, and the tasks that have ended."""

from __future__ import annotations

from twisted.trial.unittest import SynchronousTestCase

from agents.task_queue import MAX_FOLLOWED, TOMBSTONE_TTL_S, TaskQueue, select_task
from middleware.entangled.record import TOLERATED_ABSENCE_S
from middleware.tasks.task import MAX_LEASE_TTL_S, Task


def task(name: str, created: float = 0.0, priority: int = 0) -> Task:
    """Return a task."""
    return Task(name, "walk", name, created=created, priority=priority)


OLD, NEW, URGENT = task("old", 1.0), task("new", 2.0), task("urgent", 3.0, 5)


class TaskQueueTests(SynchronousTestCase):
    def test_order(self) -> None:
        """Tasks are ordered by priority, then by age; an agent takes part in a limited number of them."""
        task_queue = TaskQueue()
        for one in (NEW, URGENT, OLD):
            task_queue.add(one)
        self.assertEqual(task_queue.list_followed(), [URGENT, OLD, NEW])
        for number in range(2 * MAX_FOLLOWED):
            task_queue.add(task(f"t{number}", 9.0))
        self.assertEqual(len(task_queue.list_followed()), MAX_FOLLOWED)

    def test_ended_task_never_starts_again(self) -> None:
        """After its end a task is not accepted again for the longest lease plus the longest absence of a node."""
        task_queue = TaskQueue()
        task_queue.add(OLD)
        task_queue.mark_over("old", 0.0)
        self.assertFalse(task_queue.is_new("old"))
        self.assertFalse(task_queue.add(OLD))
        task_queue.expire_tombstones([], TOLERATED_ABSENCE_S + MAX_LEASE_TTL_S)
        self.assertFalse(task_queue.add(OLD))
        task_queue.expire_tombstones(["old"], 2 * TOMBSTONE_TTL_S)
        self.assertFalse(task_queue.add(OLD))
        task_queue.expire_tombstones([], 2 * TOMBSTONE_TTL_S)
        self.assertTrue(task_queue.is_new("old"))


class SelectTaskTests(SynchronousTestCase):
    def test_who_gets_the_body(self) -> None:
        """The first task in the queue gets the robot.

        However, the present task keeps the robot if it must not stop, or if it acts and has the same priority.
        """
        every = [NEW, OLD, URGENT]
        self.assertIs(select_task(every, None, True), URGENT)
        self.assertIs(select_task(every, OLD, True), URGENT)
        self.assertIs(select_task(every, OLD, False), OLD)
        self.assertIs(select_task([OLD, NEW], NEW, True), OLD)
        self.assertIs(select_task([OLD, NEW], NEW, False), NEW)
        self.assertIsNone(select_task([], None, True))
