"""Report: what came of a run, for people and as JSON, with the line that repeats it."""

from __future__ import annotations

import json
import shlex
from collections.abc import Sequence
from dataclasses import dataclass

from sim.team.figure import table
from sim.team.run import Outcome
from sim.team.samples import Series
from sim.team.scenario import Scenario

VERSION = 1
MOST_SHOWN = 20


@dataclass(frozen=True)
class Cost:
    """What a run took: seconds of a processor, seconds of the wall clock, and bytes of memory at its end."""

    cpu: float
    wall: float
    resident: int


def again(scenario: str, seed: int, nodes: int | None) -> str:
    """The line that repeats a run."""
    words = ["sim", "run", "--scenario", scenario, "--seed", str(seed)]
    return shlex.join(words if nodes is None else [*words, "--nodes", str(nodes)])


def text(scenario: Scenario, outcome: Outcome, cost: Cost, line: str) -> str:
    """The report for people."""
    lines = [table(outcome.figures)] if outcome.figures else []
    if outcome.is_partial:
        lines.append(f"PARTIAL   ended while {outcome.phase}, after {outcome.seconds:.1f} s; nothing above is final")
    lines += [f"VIOLATED  {violation}" for violation in outcome.violations[:MOST_SHOWN]]
    if len(outcome.violations) > MOST_SHOWN:
        lines.append(f"VIOLATED  and {len(outcome.violations) - MOST_SHOWN} more")
    lines += [f"MISSED    {figure.name}: {figure.target}" for figure in outcome.missed]
    pace = f", {outcome.seconds / cost.cpu:.2g} x real time on one core" if cost.cpu else ""
    memory = f", {cost.resident / 2**20:,.0f} MiB" if cost.resident else ""
    lines += [
        f"took      {cost.cpu:.1f} s of a processor for {outcome.seconds:.1f} s{pace}{memory}",
        f"hash      {outcome.digest}",
        f"again     {line}",
    ]
    return "\n".join(lines) + "\n"


def packed(scenario: Scenario, outcome: Outcome, cost: Cost, line: str, series: Series) -> str:
    """The report as JSON."""
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
        "figures": [figure.packed() for figure in outcome.figures],
        "violations": outcome.violations,
        "missed": [figure.name for figure in outcome.missed],
        "hash": outcome.digest,
        "again": line,
        "cpu_seconds": round(cost.cpu, 3),
        "wall_seconds": round(cost.wall, 3),
        "resident_bytes": cost.resident,
        "faults": [str(fault) for fault in scenario.faults],
        "series": _jagged(series),
    }
    return json.dumps(content, indent=1, allow_nan=False) + "\n"


def _jagged(series: Series) -> dict[str, Sequence[tuple[float, float | None]]]:
    """``series`` without what JSON does not know: None stands for what is not finite."""
    return {
        name: [(moment, value if abs(value) != float("inf") and value == value else None) for moment, value in points]
        for name, points in series.items()
    }
