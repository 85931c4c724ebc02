"""Derive events from successive states of the team.  Pure.

Events: a device arrives or leaves, a task changes its status, a group agrees on an agent, and a takeover with its
duration.  The event log starts with its node and has no earlier events.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from webnode.state import GONE, State

MAX_ENTRIES = 2000
"""Maximum number of entries: about an hour of a busy team."""
FAULT_ATTRIBUTION_S = 60.0
"""Seconds after an injected fault within which a takeover is attributed to it, if the device did not leave."""
EXECUTING = "EXECUTING"
ENDED_STATUSES = ("COMPLETED", "FAILED", "CANCELLED")


@dataclass(frozen=True)
class Entry:
    """An event: ``n`` is its number, ``at`` unix seconds, ``seconds`` its duration or None."""

    n: int
    at: float
    kind: str
    uuid: str
    task: str
    text: str
    seconds: float | None = None


@dataclass
class _Loss:
    """The device that acted on a task when a fault or its departure occurred, and the time."""

    uuid: str
    name: str
    at: float
    is_gone: bool


class EventLog:
    """The newest entries, in memory only.

    The duration of a takeover counts from the moment at which the acting device was noticed to be missing, or from the
    fault that was injected into it.
    """

    def __init__(self, max_entries: int = MAX_ENTRIES) -> None:
        self._entries: deque[Entry] = deque(maxlen=max_entries)
        self._n = 0
        self._last_state: State = {}
        self._acting: dict[str, set[str]] = {}
        self._losses: dict[str, _Loss] = {}

    def record_state(self, state: State, now: float) -> None:
        """Compare the next state, read at ``now`` (unix seconds), with the previous state."""
        before, self._last_state = self._last_state, state
        if not before:
            self._add(now, "start", text=f"{state.get('node') or 'this node'} starts to observe")
        self._compare_devices(_index_rows(before, "devices", "uuid"), _rows(state, "devices"), now)
        titles = {task["id"]: task["title"] for task in _rows(state, "tasks")}
        self._compare_tasks(_index_rows(before, "tasks", "id"), _rows(state, "tasks"), now)
        ended = {task["id"] for task in _rows(state, "tasks") if task["status"] in ENDED_STATUSES}
        # Reports on a task that has ended expire one after another; agreement among the remaining reports means
        # nothing.
        open_groups = [group for group in _rows(state, "groups") if group["task"] not in ended]
        self._compare_groups(_index_rows(before, "groups", "task"), open_groups, now)
        self._find_takeovers(state, titles, ended, now)
        self._compare_stops(before, state, now)

    def record_fault(self, uuid: str, kind: str, now: float) -> None:
        """Record an injected fault, from which the duration of a takeover counts."""
        name = _index_rows(self._last_state, "devices", "uuid").get(uuid, {}).get("name", uuid[:8])
        task = next((task for task, acting in self._acting.items() if uuid in acting), "")
        if task:
            self._losses[task] = _Loss(uuid, name, now, False)
        self._add(now, "fault", uuid, task, f"{name}: {kind} (injected fault)")

    def list_since(self, number: int, about: str = "") -> list[Entry]:
        """Return the entries after ``number``; only those about the device or task ``about`` if given."""
        if number >= self._n:
            return []
        return [entry for entry in self._entries if entry.n > number and about in ("", entry.uuid, entry.task)]

    # -- inside -----------------------------------------------------------------------------------------------------

    def _add(
        self, at: float, kind: str, uuid: str = "", task: str = "", text: str = "", seconds: float | None = None
    ) -> None:
        self._n += 1
        self._entries.append(Entry(self._n, at, kind, uuid, task, text, seconds))

    def _compare_stops(self, before: State, state: State, now: float) -> None:
        """Add an entry for each stop, for the standstill of all robots, and for the release."""
        known = {stop["id"] for stop in before.get("halt", {}).get("stops", ())}
        stops = state.get("halt", {}).get("stops", ())
        for by in dict.fromkeys(stop["by"] for stop in stops if stop["id"] not in known and stop["by"]):
            self._add(now, "halt", text=f"{by} stops the team")
        if bool(state.get("halted")) != bool(before.get("halted")):
            lost = "not every robot stands still" if stops else "the team is released"
            self._add(now, "halt", text="the team is halted" if state.get("halted") else lost)

    def _compare_devices(self, before: Mapping[str, State], devices: Iterable[State], now: float) -> None:
        for device in devices:
            uuid, name, task = device["uuid"], device["name"], device["task"]
            old = before.get(uuid)
            if device["status"] == GONE:
                if old is not None and old["status"] != GONE:
                    self._add(now, "gone", uuid, task, f"{name} is gone")
                continue
            if old is None:
                place = f", number {device['joined']}" if device["joined"] else ""
                self._add(now, "here", uuid, task, f"{name} is here{place}: {device['status'].lower()}")
            elif old["status"] == GONE:
                self._add(now, "back", uuid, task, f"{name} is back: {device['status'].lower()}")
            elif old["status"] != device["status"]:
                change = f"{old['status'].lower()} \N{RIGHTWARDS ARROW} {device['status'].lower()}"
                self._add(now, "status", uuid, task or old["task"], f"{name}: {change}")
            if old is not None:
                for _, text in [line for line in device["messages"] if line not in old["messages"]]:
                    self._add(now, "message", uuid, task, f"{name}: {text}")

    def _compare_tasks(self, before: Mapping[str, State], tasks: Iterable[State], now: float) -> None:
        for task in tasks:
            name, title, status = task["id"], task["title"], task["status"]
            old = before.get(name, {})
            if old.get("status") != status:
                result, took = task["result"], None
                change = f"{old['status'].lower()} \N{RIGHTWARDS ARROW} {status.lower()}" if old else status.lower()
                if result and status in ENDED_STATUSES:
                    took = result["took"] if status == "COMPLETED" else None
                    change += f" by {result['by']}" + (f" in {took:.1f} s" if took else "")
                self._add(now, "task", "", name, f"{title}: {change}", took)
            elif old and old["paused"] != task["paused"]:
                self._add(now, "task", "", name, f"{title}: {'paused' if task['paused'] else 'resumed'}")
            elif task["note"] and task["note"] != old.get("note"):
                self._add(now, "task", "", name, f"{title}: {task['note']}")

    def _compare_groups(self, before: Mapping[str, State], groups: Iterable[State], now: float) -> None:
        for group in groups:
            agreed = bool(group["assigned_uuid"]) and group["agree"] == group["of"]
            if agreed and _get_consensus_point(group) != _get_consensus_point(before.get(group["task"], {})):
                bids = ", ".join(f"{m['name']} {m['cost']:.2f} m" for m in group["members"] if m["cost"] is not None)
                change = f"{group['agree']} of {group['of']} agree on {group['assigned']}" + (
                    f" ({bids})" if bids else ""
                )
                self._add(now, "agreed", group["assigned_uuid"], group["task"], change)

    def _find_takeovers(self, state: State, titles: Mapping[str, str], ended: set[str], now: float) -> None:
        names = {device["uuid"]: device["name"] for device in _rows(state, "devices")}
        acting: dict[str, set[str]] = {}
        for device in _rows(state, "devices"):
            if device["status"] == EXECUTING and device["task"]:
                acting.setdefault(device["task"], set()).add(device["uuid"])
        for device in _rows(state, "devices"):
            for task in [task for task, uuids in self._acting.items() if device["uuid"] in uuids]:
                if device["status"] == GONE:
                    loss = self._losses.get(task)
                    at = loss.at if loss is not None and loss.uuid == device["uuid"] else now
                    self._losses[task] = _Loss(device["uuid"], device["name"], at, True)
        for task, uuids in acting.items():
            self._record_takeover(task, titles.get(task, task), uuids, names, now)
        for task in [*self._losses]:
            if task in ended or (not self._losses[task].is_gone and now - self._losses[task].at > FAULT_ATTRIBUTION_S):
                del self._losses[task]
        # When a task passes to another device, no device acts for some time: keep the previous device until then.
        self._acting = {**{task: uuids for task, uuids in self._acting.items() if task not in ended}, **acting}

    def _record_takeover(self, task: str, title: str, uuids: set[str], names: Mapping[str, str], now: float) -> None:
        before, loss = self._acting.get(task, set()), self._losses.get(task)
        fresh = sorted(uuids - before)
        if loss is not None and loss.is_gone and loss.uuid in uuids:
            del self._losses[task]  # the device returned before a takeover
        elif fresh and loss is not None and loss.uuid not in uuids:
            took = round(now - loss.at, 2)
            change = f"{names[fresh[0]]} takes over {title} from {loss.name}: {took:.1f} s"
            self._add(now, "takeover", fresh[0], task, change, took)
            del self._losses[task]
        elif fresh and before and not before & uuids:
            left = names.get(min(before), "a device that left")
            self._add(now, "handover", fresh[0], task, f"{names[fresh[0]]} continues {title} in place of {left}")


def _get_consensus_point(group: Mapping[str, Any]) -> tuple[Any, ...]:
    return group.get("assigned_uuid"), group.get("agree"), group.get("of")


def _rows(state: State, name: str) -> list[State]:
    rows = state.get(name)
    return rows if isinstance(rows, list) else []


def _index_rows(state: State, name: str, key: str) -> dict[str, State]:
    return {row[key]: row for row in _rows(state, name)}
