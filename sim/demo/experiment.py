"""Judge one run of the thesis' demonstration by the state of the page and the true positions of the robots.

Experiment 1: three dogs search, and the nearest approaches the target.  Experiment 2: the same, but the approaching dog
fails on its way, and another one finishes (thesis, section 5).  Time is an argument.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from sim.demo.state_changes import find_present
from sim.robots.scene import FOOTPRINT_RADIUS_M

KILL_DISTANCE_M = 0.10
"""The dog is killed when it has come this much nearer to the target, or half of its way if that is less."""
REACHED_GAP_M = 0.15
"""The gap between the dog's footprint and the target that still counts as having reached it."""
DISTANCE_TOLERANCE_M = 0.05
"""Two distances that differ by less are the same to a robot's sensor."""
LIMIT_S = 150.0

State = Mapping[str, Any]


@dataclass(frozen=True)
class Check:
    """One condition of an experiment."""

    description: str
    is_met: bool


class Experiment:
    """One task from its assignment to its end.

    :param kills: whether the approaching dog fails on its way
    :param started: the time of assignment, in seconds of the clock of ``update``
    """

    def __init__(self, title: str, task: str, kills: bool, started: float) -> None:
        self.title = title
        self.killed = ""
        self.by = ""
        self.duration_s: float | None = None
        self.takeover_s: float | None = None
        self.gap_m: float | None = None
        self._task = task
        self._kills = kills
        self._started = started
        self._killed_at = 0.0
        self._executing = ""
        self._start_distances: dict[str, dict[str, float]] = {}
        self._final_status = ""

    @property
    def is_over(self) -> bool:
        """Whether the experiment has ended: completed, failed, or out of time."""
        return bool(self._final_status)

    def update(self, now: float, state: State, snapshot: State | None) -> str:
        """Evaluate a state and snapshot; returns the name of the dog to kill now, or an empty text."""
        if self._final_status:
            return ""
        distances = measure_distances(snapshot)
        task: State = next((row for row in state.get("tasks", []) if row.get("id") == self._task), {})
        executing = [
            name
            for name, device in find_present(state).items()
            if device.get("status") == "EXECUTING" and device.get("task") == self._task and name != self.killed
        ]
        for name in executing:
            if name != self._executing:
                self._executing = name
                self._start_distances[name] = distances
        if self._check_end(now, task, distances, snapshot):
            return ""
        if self.killed:
            if self.takeover_s is None and any(_is_moving(snapshot, name) for name in executing):
                self.takeover_s = now - self._killed_at
        elif self._kills:
            target = (snapshot or {}).get("target") or {}
            for name in executing:
                began = self._start_distances[name].get(name, 0.0)
                way = began - float(target.get("radius", 0.0)) - FOOTPRINT_RADIUS_M - REACHED_GAP_M
                if began - distances.get(name, math.inf) >= min(KILL_DISTANCE_M, max(0.0, way) / 2):
                    self.killed, self._killed_at = name, now
                    return name
        return ""

    def _check_end(self, now: float, task: State, distances: Mapping[str, float], snapshot: State | None) -> bool:
        status = str(task.get("status", "absent"))
        if status in ("COMPLETED", "FAILED", "CANCELLED"):
            self._final_status = status
            self.duration_s = now - self._started
            result = task.get("result") or {}
            self.by = str(result.get("by", ""))
            target = (snapshot or {}).get("target")
            if target and self.by in distances:
                self.gap_m = distances[self.by] - float(target["radius"]) - FOOTPRINT_RADIUS_M
        elif now - self._started > LIMIT_S:
            self._final_status = f"out of time, task {status}"
        return bool(self._final_status)

    def list_checks(self) -> list[Check]:
        """Return the conditions of the experiment and whether they hold."""
        checks = [Check(f"task completed ({self._final_status or 'not over'})", self._final_status == "COMPLETED")]
        gap = "unknown" if self.gap_m is None else f"{self.gap_m:.2f} m"
        checks.append(
            Check(f"{self.by or 'nobody'} stands at the target (gap {gap})", _is_within(self.gap_m, REACHED_GAP_M))
        )
        if self._kills:
            checks.append(Check(f"{self.killed or 'nobody'} was lost on its way", bool(self.killed)))
            checks.append(Check(f"{self.by or 'nobody'} finished in its place", self.by not in ("", self.killed)))
            first = self.killed
        else:
            first = self.by
        if first:
            at = self._start_distances.get(first, {})
            nearest = min(at, key=lambda name: (at[name], name), default="nobody")
            lead = at.get(first, math.inf) - at.get(nearest, 0.0)
            checks.append(
                Check(f"{first} was the nearest when they decided (nearest: {nearest})", lead <= DISTANCE_TOLERANCE_M)
            )
        return checks

    @property
    def has_passed(self) -> bool:
        """Whether all conditions hold."""
        return all(check.is_met for check in self.list_checks())


def format_table(runs: Sequence[Experiment]) -> str:
    """Return the verdict of all experiments as text, one line per condition."""
    lines = []
    for run in runs:
        took = "" if run.duration_s is None else f", {run.duration_s:.1f} s"
        takeover = "" if run.takeover_s is None else f", takeover {run.takeover_s:.2f} s"
        lines.append(f"{'PASS' if run.has_passed else 'FAIL'}  {run.title}{took}{takeover}")
        lines += [f"      {'yes' if check.is_met else 'NO '}  {check.description}" for check in run.list_checks()]
    return "\n".join(lines)


def make_report(runs: Sequence[Experiment]) -> list[dict[str, Any]]:
    """Return the verdict as data for JSON."""
    return [
        {
            "title": run.title,
            "held": run.has_passed,
            "by": run.by,
            "killed": run.killed,
            "took_s": run.duration_s,
            "takeover_s": run.takeover_s,
            "gap_m": run.gap_m,
            "checks": {check.description: check.is_met for check in run.list_checks()},
        }
        for run in runs
    ]


def measure_distances(snapshot: State | None) -> dict[str, float]:
    """Return the distance of each dog to the target in metres, between centres; empty without a target."""
    target = (snapshot or {}).get("target")
    if not snapshot or not target:
        return {}
    return {dog["name"]: math.hypot(dog["x"] - target["x"], dog["y"] - target["y"]) for dog in snapshot["dogs"]}


def _is_moving(snapshot: State | None, name: str) -> bool:
    return any(dog["name"] == name and bool(dog.get("moving")) for dog in (snapshot or {}).get("dogs", []))


def _is_within(value: float | None, limit: float) -> bool:
    return value is not None and value <= limit
