"""Catalogue: the predefined tasks that a person can choose from (thesis, Algorithm 4.4: ``tasks[choice]``)."""

from __future__ import annotations

from dataclasses import replace

from middleware.errors import UnknownTask
from middleware.tasks.task import Task

DEMO = "find-red-target"
STOP = 0.1
"""Seconds in which a dog that turns at 1.2 rad/s, or walks, stands still."""

TASKS = {
    DEMO: Task(
        task_id="",
        kind="find-target",
        title="Find the red target",
        requirements={"base2d": {}, "camera": {"width": 104}, "odometry": {}},
        parameters={"target_radius": 0.08, "target_height": 0.22},
        waiting_period=15.0,
        stop_time=STOP,
    ),
    "turn-around": Task(
        task_id="",
        kind="turn-around",
        title="Turn around once",
        requirements={"base2d": {}, "odometry": {}, "power": {}},
        waiting_period=1.0,
        stop_time=STOP,
    ),
    # Whatever sees can do it: a dog turns by itself, a phone is turned by its visitor.
    "watch-target": Task(
        task_id="",
        kind="watch-target",
        title="Keep the red target in view",
        requirements={"camera": {}},
        parameters={"seconds": 20.0, "target_radius": 0.08, "target_height": 0.22},
        waiting_period=8.0,
        stall_limit=12.0,
        stop_time=STOP,
    ),
    "fetch-the-ball": Task(
        task_id="",
        kind="fetch",
        title="Fetch the ball",
        requirements={"base2d": {}, "camera": {}, "gripper": {}},
    ),
}


def task_named(name: str, task_id: str, created: float) -> Task:
    """The predefined task ``name`` as a new task; raises ``UnknownTask``, which names those that there are."""
    template = TASKS.get(name)
    if template is None:
        raise UnknownTask(f"no predefined task is called {name!r}; there are {', '.join(sorted(TASKS))}")
    return replace(template, task_id=task_id, created=created)
