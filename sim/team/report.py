"""Report the result of a run, with the command that repeats the run; sample figures, and write the trace."""

from __future__ import annotations

import json
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TextIO

from sim.team.metric import format_table
from sim.team.run import Outcome, Run
from sim.team.scenario import Scenario

VERSION = 1
MAX_SHOWN_VIOLATIONS = 20
MAX_SAMPLES = 240
"""Maximum number of samples of a run; if a run takes longer than expected, every other sample is dropped."""
METRICS_EVERY = 6
"""The figures of workloads, some of which are expensive, are included only in every sixth sample."""

Series = dict[str, list[tuple[float, float]]]


class Samples:
    """Samples of a run over the team's time: (time, value) by name."""

    def __init__(self) -> None:
        self.series: Series = {}
        self._every = 0.0
        self._next = 0.0
        self._taken = 0
        self._before = (0.0, 0, 0)

    def update(self, run: Run) -> None:
        """Take a sample if one is due."""
        now = run.team.clock.seconds()
        if now < self._next:
            return
        self._every = self._every or run.expected_end / MAX_SAMPLES
        self._next = now + self._every
        self._taken += 1
        team, (then, sent, size) = run.team, self._before
        total = team.switchboard.counters["sent"]
        bytes_sent = sum(team.traffic(place).sent_bytes for place in team.places)
        passed, alive = now - then, len(team.living)
        self._add("nodes alive", now, alive)
        self._add("nodes in the network", now, len(team.get_joined()))
        if passed and alive:
            self._add("datagrams per node and second", now, (total - sent) / passed / alive)
            self._add("bytes per node and second", now, (bytes_sent - size) / passed / alive)
        self._before = now, total, bytes_sent
        if run.began_at is not None and self._taken % METRICS_EVERY == 0:
            for metric in run.collect_metrics():
                if metric.is_exact and metric.value is not None:
                    self._add(metric.name, now, metric.value)
        if self._taken > 2 * MAX_SAMPLES:
            self.series = {name: points[::2] for name, points in self.series.items()}
            self._every *= 2
            self._taken //= 2

    def _add(self, name: str, now: float, value: float) -> None:
        self.series.setdefault(name, []).append((round(now, 3), value))


@dataclass(frozen=True)
class Cost:
    """The cost of a run: processor seconds, wall clock seconds, and bytes of memory at its end."""

    cpu: float
    wall: float
    resident: int


def make_repeat_command(scenario: str, seed: int, nodes: int | None) -> str:
    """Return the command that repeats a run."""
    words = ["sim", "run", "--scenario", scenario, "--seed", str(seed)]
    return shlex.join(words if nodes is None else [*words, "--nodes", str(nodes)])


def format_text(scenario: Scenario, outcome: Outcome, cost: Cost, line: str) -> str:
    """Return the report as text."""
    lines = [format_table(outcome.metrics)] if outcome.metrics else []
    if outcome.is_partial:
        lines.append(f"PARTIAL   ended while {outcome.phase}, after {outcome.seconds:.1f} s; nothing above is final")
    lines += [f"VIOLATED  {violation}" for violation in outcome.violations[:MAX_SHOWN_VIOLATIONS]]
    if len(outcome.violations) > MAX_SHOWN_VIOLATIONS:
        lines.append(f"VIOLATED  and {len(outcome.violations) - MAX_SHOWN_VIOLATIONS} more")
    lines += [f"MISSED    {figure.name}: {figure.target}" for figure in outcome.missed]
    pace = f", {outcome.seconds / cost.cpu:.2g} x real time on one core" if cost.cpu else ""
    memory = f", {cost.resident / 2**20:,.0f} MiB" if cost.resident else ""
    lines += [
        f"took      {cost.cpu:.1f} s of a processor for {outcome.seconds:.1f} s{pace}{memory}",
        f"hash      {outcome.digest}",
        f"again     {line}",
    ]
    return "\n".join(lines) + "\n"


def format_json(scenario: Scenario, outcome: Outcome, cost: Cost, line: str, series: Series) -> str:
    """Return the report as JSON."""
    content = {
        "report": VERSION,
        "scenario": scenario.name,
        "about": scenario.about,
        "seed": outcome.seed,
        "nodes": scenario.nodes,
        "kind": scenario.kind,
        "partial": outcome.is_partial,
        "phase": outcome.phase,
        "seconds": round(outcome.seconds, 6),
        "figures": [metric.to_json() for metric in outcome.metrics],
        "violations": outcome.violations,
        "missed": [metric.name for metric in outcome.missed],
        "hash": outcome.digest,
        "again": line,
        "cpu_seconds": round(cost.cpu, 3),
        "wall_seconds": round(cost.wall, 3),
        "resident_bytes": cost.resident,
        "faults": [str(fault) for fault in scenario.faults],
        "series": _replace_infinite(series),
    }
    return json.dumps(content, indent=1, allow_nan=False) + "\n"


def _replace_infinite(series: Series) -> dict[str, Sequence[tuple[float, float | None]]]:
    """Return ``series`` with None for values that are not finite, which JSON cannot represent."""
    return {
        name: [(moment, value if abs(value) != float("inf") and value == value else None) for moment, value in points]
        for name, points in series.items()
    }


MAX_LINES = 200_000
"""Maximum number of lines; further lines are omitted, and the last line contains their number."""


class Trace:
    """Writes the events of a team to ``out`` (``Team.write_event``)."""

    def __init__(self, out: TextIO, most: int = MAX_LINES) -> None:
        self._out = out
        self._max_lines = most
        self._count = 0

    def begin(self, **facts: object) -> None:
        """Write the parameters of the run."""
        self._write({"trace": 1, **facts})

    def write_event(self, now: float, event: str, place: int, more: str) -> None:
        """Write one event: the time in seconds, its name, its place, and details."""
        self._count += 1
        if self._count > self._max_lines:
            return
        line: dict[str, object] = {"at": round(now, 6), "event": event}
        if place >= 0:
            line["place"] = place
        if more:
            line["more"] = more
        self._write(line)

    def end(self, **facts: object) -> None:
        """Write the last line, with the number of omitted events."""
        self._write({"end": True, "events": self._count, "left_out": max(0, self._count - self._max_lines), **facts})
        self._out.flush()

    def _write(self, line: dict[str, object]) -> None:
        self._out.write(json.dumps(line, separators=(",", ":")) + "\n")
