"""Convert the records of the team to the view that the page shows.  Pure.

The view has the four parts of the thesis (section 4.2.4): the devices, the data that each stores, its objective, and
the consensus point of each group.  Two web nodes with the same records make the same view, whatever the order of the
records.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from webnode.sanitize import clean_count, clean_distance, clean_number, clean_properties, clean_text, clean_texts

State = dict[str, Any]
Fields = Mapping[str, Any]

DEVICE_STATUSES = ("IDLE", "ASSIGNED", "SEARCHING", "WAITING", "EXECUTING", "DONE")
TASK_STATUSES = ("OPEN", "ASSIGNED", "EXECUTING", "COMPLETED", "FAILED", "CANCELLED")
UNKNOWN = "UNKNOWN"
GONE = "GONE"
DEPARTED_SHOWN_S = 60.0
MAX_MESSAGES = 5
MAX_DISTANCE_M = 1e6
"""Maximum distance of a device from the origin of its frame, in metres."""


def format_state(
    devices: Iterable[Fields],
    tasks: Iterable[Fields],
    groups: Mapping[str, Sequence[Fields]],
    *,
    departed: Iterable[State] = (),
    node: str = "",
) -> State:
    """Return the whole view: devices in the order of joining, tasks newest first, groups in the order of the tasks.

    ``departed`` are the devices that left recently (``DepartedDevices.update``); ``node`` is the name of the
    serving node.
    """
    present = [view for view in map(make_device_view, devices) if view["uuid"]]
    known = {view["uuid"] for view in present}
    gone = [view for view in departed if view["uuid"] not in known]
    shown = sorted([*present, *gone], key=lambda view: (view["joined"], view["uuid"]))
    listed = [view for view in map(make_task_view, tasks) if view["id"]]
    listed.sort(key=lambda view: (-view["created"], view["id"]))
    titles = {view["id"]: view["title"] for view in listed}
    for view in shown:
        view["objective"] = titles.get(view["task"], view["task"])
    # A winner that has just failed no longer reports, but the reports of the standbys still contain it.
    names = {view["uuid"]: view["name"] for view in shown}
    order = {view["id"]: place for place, view in enumerate(listed)}
    keys = sorted((key for key in groups if groups[key]), key=lambda key: (order.get(key, len(order)), key))
    return {
        "node": clean_text(node),
        "devices": shown,
        "tasks": listed,
        "groups": [make_group_view(key, titles.get(key, key), groups[key], names) for key in keys],
    }


def make_device_view(fields: Fields) -> State:
    """Return one device as the page shows it; missing and invalid fields become empty."""
    network, deployed = fields.get("network"), fields.get("deployed")
    deployed = deployed if isinstance(deployed, Mapping) else {}
    return {
        "uuid": clean_text(fields.get("uuid"), limit=64),
        "name": clean_text(fields.get("name"), "unnamed", 64),
        "kind": clean_text(fields.get("kind"), limit=64),
        "description": clean_text(fields.get("description")),
        "capabilities": clean_properties(fields.get("capabilities")),
        "address": clean_text(fields.get("address"), limit=64),
        "roles": clean_texts(fields.get("roles")),
        "joined": clean_count(fields.get("joined")),
        "since": clean_number(fields.get("since")),
        "task": clean_text(fields.get("task"), limit=64),
        "status": _read_status(fields.get("status"), DEVICE_STATUSES),
        "messages": _read_messages(fields.get("messages")),
        "network": {clean_text(key): clean_number(value) for key, value in network.items()}
        if isinstance(network, Mapping)
        else {},
        "deployed": {clean_text(key): clean_text(value, limit=200) for key, value in deployed.items()},
        "position": _read_position(fields.get("position")),
        "laptop": clean_text(fields.get("laptop"), limit=64),
        "agent": clean_text(fields.get("agent"), limit=64),
        "stops": clean_texts(fields.get("stops")),
        "obeys": clean_text(fields.get("obeys"), limit=64),
        "gone": None,
    }


def make_task_view(fields: Fields) -> State:
    """Return one task as the page shows it."""
    note, result, why = fields.get("note"), fields.get("result"), fields.get("why")
    return {
        "id": clean_text(fields.get("id"), limit=64),
        "kind": clean_text(fields.get("kind"), limit=64),
        "title": clean_text(fields.get("title")) or clean_text(fields.get("kind")) or "untitled",
        "requirements": clean_properties(fields.get("requirements")),
        "waiting_period": clean_number(fields.get("waiting_period")),
        "strategy": clean_text(fields.get("strategy")),
        "group": clean_text(fields.get("group"), limit=64),
        "created": clean_number(fields.get("created")),
        "council": clean_texts(fields.get("council")),
        "paused": fields.get("paused") is True,
        "priority": clean_count(fields.get("priority")),
        "deadline": clean_number(fields.get("deadline")),
        "status": _read_status(fields.get("status"), TASK_STATUSES),
        "note": "\n".join(clean_texts(note.split("\n"))) if isinstance(note, str) else "",
        "result": _make_result(result) if isinstance(result, Mapping) else None,
        "why": [_make_decision_view(epoch) for epoch in why.get("epochs", ())] if isinstance(why, Mapping) else [],
    }


def make_group_view(task: str, title: str, members: Sequence[Fields], known: Mapping[str, str] | None = None) -> State:
    """Return the consensus point of one group: the winner that each agent computed, and whether they agree.

    The point is the agent that most members computed (among equals, the lowest uuid).  ``differ`` lists the members
    with a different winner, ``undecided`` the members that have none yet.  ``known`` names devices without a report
    (uuid to name).  ``share`` is the cost (metres) relative to the largest.
    """
    views = [_make_member_view(member) for member in members]
    views.sort(key=lambda view: (view["name"], view["uuid"]))
    names = {**(known or {}), **{view["uuid"]: view["name"] for view in views}}
    farthest = max((view["cost"] for view in views if view["cost"] is not None), default=0.0)
    votes: dict[str, int] = {}
    for view in views:
        view["share"] = None if view["cost"] is None else round(view["cost"] / farthest, 4) if farthest else 0.0
        if view["assigned"]:
            votes[view["assigned"]] = votes.get(view["assigned"], 0) + 1
    winner = min(votes, key=lambda uuid: (-votes[uuid], uuid), default="")
    for view in views:
        view["choice"] = names.get(view["assigned"], view["assigned"][:8])
    return {
        "task": clean_text(task, limit=64),
        "title": title,
        "members": views,
        "scale": farthest,
        "assigned": names.get(winner, winner[:8]),
        "assigned_uuid": winner,
        "agree": votes.get(winner, 0),
        "of": len(views),
        "differ": [view["name"] for view in views if view["assigned"] and view["assigned"] != winner],
        "undecided": [view["name"] for view in views if not view["assigned"]],
    }


class DepartedDevices:
    """Keeps devices for some time after they have left, so that the page shows them as gone."""

    def __init__(self, shown_s: float = DEPARTED_SHOWN_S) -> None:
        self._shown_s = shown_s
        self._last: dict[str, State] = {}
        self._gone: dict[str, State] = {}

    def update(self, devices: Iterable[Fields], now: float) -> list[State]:
        """Return the devices that left recently; ``gone`` is the unix time at which this was noticed.

        Safe to call from several threads: each call replaces the stored tables and modifies nothing in place.
        """
        present = {view["uuid"]: view for view in map(make_device_view, devices) if view["uuid"]}
        left = {uuid: {**view, "status": GONE, "gone": now} for uuid, view in self._last.items() if uuid not in present}
        gone = {**left, **self._gone}
        gone = {u: v for u, v in gone.items() if u not in present and now - v["gone"] < self._shown_s}
        self._last, self._gone = present, gone
        return [dict(view) for view in gone.values()]


def _make_member_view(fields: Fields) -> State:
    return {
        "uuid": clean_text(fields.get("uuid"), limit=64),
        "name": clean_text(fields.get("name"), "unnamed", 64),
        "status": _read_status(fields.get("status"), DEVICE_STATUSES),
        "cost": clean_distance(fields.get("cost")),
        "assigned": clean_text(fields.get("assigned"), limit=64),
        "token": clean_count(fields.get("token")),
        "why": clean_text(fields.get("why"), limit=600),
        "state": clean_text(fields.get("state"), limit=32),
        "epoch": clean_count(fields.get("epoch")),
        "available": fields.get("available") is not False,
        "progress": clean_distance(fields.get("progress")),
        "post": None if fields.get("post") is None else round(math.degrees(clean_number(fields.get("post")))),
    }


def _make_result(fields: Fields) -> State:
    return {"by": clean_text(fields.get("by")), "took": clean_number(fields.get("took"))}


def _make_decision_view(fields: Fields) -> State:
    """Return one epoch of an ``Explanation``, with a row per device that reported or differs."""
    standby, winner = list(fields["standby"]), fields["winner"]
    differ = {each["name"]: each["what"] for each in fields["differ"]}
    rows: dict[str, State] = {}
    for report in fields["reports"]:
        name = report["name"]
        note = "goes" if report["agent"] == winner else "stands by" if name in standby else ""
        words = "; ".join(filter(None, (note, clean_text(report["more"], limit=64))))
        rows[name] = {"name": clean_text(name, limit=64), "cost": clean_number(report["cost"]), "note": words}
    for name in (*fields["silent"], *differ):
        rows.setdefault(name, {"name": clean_text(name, limit=64), "cost": None, "note": ""})
    for name, what in differ.items():
        rows[name]["note"] = f"differs: {clean_text(what, limit=200)}"
    return {
        "epoch": clean_count(fields["epoch"]),
        "chosen": clean_text(fields["chosen"], limit=64),
        "agree": len(fields["agree"]),
        "of": clean_count(fields["of"]),
        "differ": clean_texts(list(differ)),
        "rule": clean_text(f"{fields['rule']} {fields['version']}".strip(), limit=100),
        "hysteresis": clean_text(fields["hysteresis"], limit=200),
        "agreed": clean_text(fields["agreed"], limit=64),
        "digest": clean_text(fields["digest"], limit=64),
        "token": clean_count(fields["token"]),
        "reported": clean_count(fields["reported"]),
        "rows": list(rows.values()),
    }


def _read_position(value: object) -> State | None:
    """Return the position of a device in metres on its map, or in degrees on the globe; None if it reports neither."""
    reported = value if isinstance(value, Mapping) else {}
    x, y, heading, lat, lon, accuracy = (
        clean_number(reported.get(key), math.nan) for key in ("x", "y", "heading", "lat", "lon", "accuracy")
    )
    if abs(x) <= MAX_DISTANCE_M and abs(y) <= MAX_DISTANCE_M:
        return {"x": x, "y": y, "heading": None if math.isnan(heading) else heading}
    if abs(lat) <= 90.0 and abs(lon) <= 180.0:
        return {"lat": lat, "lon": lon, "accuracy": accuracy if accuracy >= 0.0 else None}
    return None


def _read_status(value: object, allowed: Sequence[str]) -> str:
    return value if isinstance(value, str) and value in allowed else UNKNOWN


def _read_messages(value: object) -> list[list[float | str]]:
    if not isinstance(value, list | tuple):
        return []
    pairs = [entry for entry in value if isinstance(entry, list | tuple) and len(entry) == 2]
    return [[clean_number(moment), clean_text(words)] for moment, words in pairs[-MAX_MESSAGES:]]
