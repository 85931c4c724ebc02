"""Build the state that the page shows from the records of the team (thesis, Algorithm 4.3).

Flask's threads read the SQLite file, the live stream reads the watched records; both build the same state.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict
from typing import Any

from middleware.directory.presence import MAX_STOPS
from middleware.frontend.team_view import Progress, Read, TeamView
from middleware.stop.stop_state import STANDS_STILL
from middleware.tasks.task import Task
from webnode.state import GONE, DepartedDevices, State, format_state

MAX_TASKS = 20
MAX_LISTED_STOPS = 64
"""Maximum number of stops listed; further stops are listed when these are released."""
MAX_AGE_S = 0.1
"""Maximum age of a cached state in seconds; it bounds the work when many clients ask at once."""


class StateCache:
    """A cache of the newest state for callers on any thread, refreshed at most every ``MAX_AGE_S``."""

    def __init__(self, read: Callable[[], State], clock: Callable[[], float]) -> None:
        self._read = read
        self._clock = clock
        self._cached: tuple[float, State] = (-MAX_AGE_S, {})

    def __call__(self) -> State:
        """Return the state; it is shared and must not be modified."""
        now, (at, state) = self._clock(), self._cached
        if not state or now - at >= MAX_AGE_S:
            state = self._read()
            self._cached = (now, state)
        return state


def build_state(read: Read, departed: DepartedDevices, node: str, now: float) -> State:
    """Return the state at ``now`` (unix s); ``departed`` keeps devices that left, ``node`` is the serving node."""
    view = TeamView(read)
    devices = view.devices
    names = {device.uuid: device.name for device in devices}
    rows, groups = [], {}
    for task in view.tasks[:MAX_TASKS]:
        progress = view.find_progress(task)
        groups[task.task_id] = [
            {**vars(member), "name": names.get(member.uuid, member.name)} for member in progress.members
        ]
        rows.append({**_make_task_row(task, progress, view), "why": asdict(view.explain(task.task_id))})
    device_rows = [dict(vars(device)) for device in devices]
    state = format_state(device_rows, rows, groups, departed=departed.update(device_rows, now), node=node)
    return {**state, **_make_stop_view(view.stops, state["devices"])}


def _make_task_row(task: Task, progress: Progress, view: TeamView) -> dict[str, Any]:
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
            note = "no device is free: " + "; ".join(f"{m.name} {m.why}" for m in members)
    else:
        status = "OPEN"
        unable, devices = view.find_unable_devices(task), view.devices
        if not devices:
            note = "no devices in the team"
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


def _make_stop_view(stops: Mapping[str, str], devices: Iterable[State]) -> State:
    """Return ``halted``, and in ``halt`` the stops, the robots that stand still, and the reports of all other robots.

    ``halted`` is true only if every robot confirms that it stands still for every stop in force.  A stop that is
    ordered but not confirmed is shown as such, and so is a robot that has not received a release.  ``stops`` (id to
    operator) are the stops that the team knows; ``devices`` are the rows of the page.  The last report of a robot that
    left still applies, because the robot stands still until it receives a release.
    """
    robots = [row for row in devices if row["capabilities"]]
    standing = [row for row in robots if _is_standing(row, stops)]
    # A robot may obey a stop whose records have expired.  List this stop, so that an operator can release it.
    known = {**dict.fromkeys((stop for row in robots for stop in row["stops"]), ""), **stops}
    others = [{"name": row["name"], "says": _describe_stop(row)} for row in robots if row not in standing]
    return {
        "halted": bool(known) and not others,
        "halt": {
            "ordered": bool(stops),
            "stops": [{"id": stop, "by": known[stop]} for stop in sorted(known)[:MAX_LISTED_STOPS]],
            "standing": [row["name"] for row in standing],
            "others": others if known else [],
        },
    }


def _is_standing(row: Mapping[str, Any], stops: Mapping[str, str]) -> bool:
    obeyed = set(row["stops"])
    return bool(row["obeys"] == STANDS_STILL and obeyed and (obeyed >= set(stops) or len(obeyed) == MAX_STOPS))


def _describe_stop(row: Mapping[str, Any]) -> str:
    if row["status"] == GONE:
        return "has left and has not confirmed"
    return "has not confirmed" if row["obeys"] in ("", STANDS_STILL) else str(row["obeys"])
