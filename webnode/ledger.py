"""Ledger: what the data store says of the team, as the state that the page shows (thesis, Algorithm 4.3).

``read`` is all it knows of the store: a key in, the records under it out.  Flask's threads hand in the SQLite file's
reader, the live stream what the node watches; both make the same state.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from typing import Any

from middleware.consensus.verdict import verdict_of, verdicts_key
from middleware.diagnostics.explanation import explained
from middleware.directory.presence import DEVICES, Device, devices_of
from middleware.entangled.record import Record
from middleware.stop.halt import HALT, stops_in
from middleware.tasks.order import PAUSE, order_of
from middleware.tasks.task import TASKS, Task, council_of, group_key, member_of, outcome_of, refusals, tasks_of
from webnode.state import Departed, State, state_of
from webnode.stopped import stopped_view

Read = Callable[[bytes], list[Record]]
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
    devices = [device for device, _ in devices_of(read(DEVICES))]
    tasks = sorted(tasks_of(read(TASKS)).values(), key=lambda task: (-task.created, task.task_id))
    names = {device.uuid: device.name for device in devices}
    rows, groups = [], {}
    for task in tasks[:TASKS_SHOWN]:
        records = read(group_key(task.task_id))
        members = [m for r in records if (m := member_of(r)) is not None]
        groups[task.task_id] = [{**asdict(member), "name": names.get(member.uuid, member.name)} for member in members]
        rows.append({**_task_row(task, records, devices), "why": _why(task, read(verdicts_key(task.task_id)))})
    views = [_device_row(device) for device in devices]
    state = state_of(views, rows, groups, departed=departed.of(views, now), node=node)
    stops = {stop.hex(): by for stop, by in stops_in(read(HALT)).items()}
    return {**state, **stopped_view(stops, state["devices"])}


def refused_by(task: Task, devices: list[Device]) -> dict[str, list[str]]:
    """Why each of ``devices`` cannot do ``task``, by name; those that can are left out (Algorithm 4.4)."""
    reasons = {device.name: refusals(device.capabilities, task.requirements) for device in devices}
    return {name: why for name, why in reasons.items() if why}


def _device_row(device: Device) -> dict[str, Any]:
    return asdict(device)


def _task_row(task: Task, records: list[Record], devices: list[Device]) -> dict[str, Any]:
    outcome = outcome_of(task, records)
    members = [m for r in records if (m := member_of(r)) is not None]
    order = order_of(records)
    is_paused = outcome is None and order is not None and order.word == PAUSE
    note = f"paused by {order.by}" if is_paused and order is not None else ""
    if outcome is not None:
        status = outcome.outcome
        reports = "reports: " + ", ".join(f"{name} {cost:.2f}" for name, cost in outcome.bids) if outcome.bids else ""
        note = "; ".join(filter(None, (outcome.why, reports)))
    elif any(m.status == "EXECUTING" for m in members):
        status = "EXECUTING"
    elif members:
        status = "ASSIGNED"
        if not (is_paused or any(m.available for m in members)):
            note = "nobody is free for it: " + "; ".join(f"{m.name} {m.why}" for m in members)
    else:
        status = "OPEN"
        refused = refused_by(task, devices)
        if not devices:
            note = "no device is here"
        elif len(refused) == len(devices):
            note = "no device can do it: " + "; ".join(f"{name} {', '.join(why)}" for name, why in refused.items())
    return {
        "id": task.task_id,
        "kind": task.kind,
        "title": task.title,
        "requirements": task.requirements,
        "waiting_period": task.waiting_period,
        "strategy": task.strategy,
        "group": task.group,
        "created": task.created,
        "council": [str(contact.address) for contact in council_of(task, records).council],
        "status": status,
        "note": note,
        "paused": is_paused,
        "priority": task.priority,
        "deadline": task.deadline,
        "result": None if outcome is None else {"by": outcome.by, "took": outcome.took},
    }


def _why(task: Task, records: list[Record]) -> dict[str, Any]:
    verdicts = [verdict for record in records if (verdict := verdict_of(record)) is not None]
    return asdict(explained(verdict for verdict in verdicts if verdict.task == task.task_id))
