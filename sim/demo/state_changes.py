"""Describe the changes between two states of the page as text."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

State = Mapping[str, Any]


def describe_changes(before: State, after: State) -> list[str]:
    """Return one line per change: devices, then tasks, then groups."""
    return [*_describe_devices(before, after), *_describe_tasks(before, after), *_describe_groups(before, after)]


def find_present(state: State) -> dict[str, State]:
    """Return the devices that are in the network, by name."""
    return {str(device["name"]): device for device in _rows(state, "devices") if not _is_gone(device)}


def _describe_devices(before: State, after: State) -> list[str]:
    lines = []
    earlier = {str(device["uuid"]): device for device in _rows(before, "devices")}
    for device in _rows(after, "devices"):
        name, status = device["name"], device.get("status", "")
        old = earlier.pop(str(device["uuid"]), None)
        if _is_gone(device):
            if old is not None and not _is_gone(old):
                lines.append(f"{name} is gone")
        elif old is None:
            lines.append(f"{name} joined")
        elif _is_gone(old):
            lines.append(f"{name} is back")
        elif old.get("status") != status:
            lines.append(f"{name}: {old.get('status')} -> {status}")
    lines += [f"{device['name']} is gone" for device in earlier.values() if not _is_gone(device)]
    return lines


def _describe_tasks(before: State, after: State) -> list[str]:
    lines = []
    earlier = {task["id"]: task for task in _rows(before, "tasks")}
    for task in _rows(after, "tasks"):
        old = earlier.get(task["id"], {})
        title, status, result = task.get("title", "task"), task.get("status"), task.get("result")
        if old.get("status") != status:
            change = f"{old['status']} -> {status}" if old else f"{status}"
            done = f" by {result['by']} in {float(result['took']):.1f} s" if result else ""
            lines.append(f"task {title!r}: {change}{done}")
        if task.get("note") and task.get("note") != old.get("note"):
            lines.append(f"task {title!r}: {task['note']}")
    return lines


def _describe_groups(before: State, after: State) -> list[str]:
    lines = []
    earlier = {group["task"]: group for group in _rows(before, "groups")}
    for group in _rows(after, "groups"):
        old = earlier.get(group["task"], {})
        point = (group.get("assigned"), group.get("agree"), group.get("of"))
        if group.get("assigned") and point != (old.get("assigned"), old.get("agree"), old.get("of")):
            bids = [
                f"{member['name']} {float(member['cost']):.2f} m"
                for member in _rows(group, "members")
                if member.get("cost") is not None
            ]
            because = f" ({', '.join(bids)})" if bids else ""
            lines.append(f"{group.get('agree')} of {group.get('of')} agree on {group['assigned']}{because}")
    return lines


def _rows(state: State, key: str) -> Sequence[State]:
    rows = state.get(key)
    return rows if isinstance(rows, list) else []


def _is_gone(device: State) -> bool:
    return device.get("gone") is not None or device.get("status") == "GONE"
