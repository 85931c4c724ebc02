"""Ledger: what the data store says of the team, as the state that the page shows (thesis, Algorithm 4.3).

Flask's threads read the SQLite file, the live stream reads what the node watches; both make the same state.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from typing import Any

from middleware.frontend.view import Progress, Read, TeamView
from middleware.tasks.task import Task
from webnode.state import Departed, State, state_of
from webnode.stopped import stopped_view

TASKS_SHOWN = 20
FRESH_S = 0.1
"""A state as old as this will do: nobody can tell, and a hundred who ask at once are answered by ten."""


class Glance:
    """The newest state for whoever asks, on any thread, read at most each ``FRESH_S``."""

    def __init__(self, read: Callable[[], State], clock: Callable[[], float]) -> None:
        self._read = read
        self._clock = clock
        self._seen: tuple[float, State] = (-FRESH_S, {})

    def __call__(self) -> State:
        """Return it; it is shared, and nobody writes in it."""
        now, (at, state) = self._clock(), self._seen
        if not state or now - at >= FRESH_S:
            state = self._read()
            self._seen = (now, state)
        return state


def state_from(read: Read, departed: Departed, node: str, now: float) -> State:
    """The whole state at ``now`` (unix s); ``departed`` remembers who left, ``node`` is the name of who serves."""
    view = TeamView(read)
    devices = view.devices
    names = {device.uuid: device.name for device in devices}
    rows, groups = [], {}
    for task in view.tasks[:TASKS_SHOWN]:
        progress = view.progress(task)
        groups[task.task_id] = [
            {**vars(member), "name": names.get(member.uuid, member.name)} for member in progress.members
        ]
        rows.append({**_task_row(task, progress, view), "why": asdict(view.explain(task.task_id))})
    device_rows = [dict(vars(device)) for device in devices]
    state = state_of(device_rows, rows, groups, departed=departed.of(device_rows, now), node=node)
    return {**state, **stopped_view(view.stops, state["devices"])}


def _task_row(task: Task, progress: Progress, view: TeamView) -> dict[str, Any]:
    outcome, members = progress.outcome, progress.members
    note = f"paused by {progress.paused_by}" if progress.paused_by else ""
    if outcome is not None:
        status = outcome.outcome
        reports = "reports: " + ", ".join(f"{name} {cost:.2f}" for name, cost in outcome.bids) if outcome.bids else ""
        note = "; ".join(filter(None, (outcome.why, reports)))
    elif any(m.status == "EXECUTING" for m in members):
        status = "EXECUTING"
    elif members:
        status = "ASSIGNED"
        if not (progress.paused_by or any(m.available for m in members)):
            note = "nobody is free for it: " + "; ".join(f"{m.name} {m.why}" for m in members)
    else:
        status = "OPEN"
        unable, devices = view.unable(task), view.devices
        if not devices:
            note = "no device is here"
        elif len(unable) == len(devices):
            note = "no device can do it: " + "; ".join(f"{name} {', '.join(why)}" for name, why in unable.items())
    return {
        "id": task.task_id,
        "kind": task.kind,
        "title": task.title,
        "requirements": task.requirements,
        "waiting_period": task.waiting_period,
        "strategy": task.strategy,
        "group": task.group,
        "created": task.created,
        "council": list(progress.council),
        "status": status,
        "note": note,
        "paused": bool(progress.paused_by),
        "priority": task.priority,
        "deadline": task.deadline,
        "result": None if outcome is None else {"by": outcome.by, "took": outcome.took},
    }
