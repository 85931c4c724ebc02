"""The predefined tasks that an operator can choose from (thesis, Algorithm 4.4: ``tasks[choice]``)."""

from __future__ import annotations

from dataclasses import replace

from middleware.errors import UnknownTask
from middleware.tasks.task import Task

DEMO_TASK = "find-red-target"
STOP_TIME_S = 0.1
"""Seconds that a dog needs to stop from walking or from a turn at 1.2 rad/s."""

TASKS = {
    DEMO_TASK: Task(
        task_id="",
        kind="find-target",
        title="Find the red target",
        requirements={"base2d": {}, "camera": {"width": 104}, "odometry": {}},
        parameters={"target_radius": 0.08, "target_height": 0.22},
        waiting_period=15.0,
        stop_time=STOP_TIME_S,
    ),
    "turn-around": Task(
        task_id="",
        kind="turn-around",
        title="Turn around once",
        requirements={"base2d": {}, "odometry": {}, "power": {}},
        waiting_period=1.0,
        stop_time=STOP_TIME_S,
    ),
    # Any device with a camera can do this task: a dog turns itself, a phone is turned by its user.
    "watch-target": Task(
        task_id="",
        kind="watch-target",
        title="Keep the red target in view",
        requirements={"camera": {}},
        parameters={"seconds": 20.0, "target_radius": 0.08, "target_height": 0.22},
        waiting_period=8.0,
        stall_limit=12.0,
        stop_time=STOP_TIME_S,
    ),
    "fetch-the-ball": Task(
        task_id="",
        kind="fetch",
        title="Fetch the ball",
        requirements={"base2d": {}, "camera": {}, "gripper": {}},
    ),
}


def create_task(name: str, task_id: str, created: float) -> Task:
    """Return the predefined task ``name`` as a new task; raise ``UnknownTask``, which lists the known names."""
    template = TASKS.get(name)
    if template is None:
        raise UnknownTask(f"no predefined task {name!r}; known tasks: {', '.join(sorted(TASKS))}")
    return replace(template, task_id=task_id, created=created)
