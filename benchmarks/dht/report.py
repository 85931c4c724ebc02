"""Format the figures as a table, with the ratio of this library to each other one, and the targets."""

from __future__ import annotations

from collections.abc import Mapping

from benchmarks.dht.library import LIBRARIES, OURS, OURS_IN_MEMORY
from benchmarks.dht.rows import ROWS, Result
from benchmarks.dht.target import check_targets

Results = Mapping[str, Mapping[str, Result]]
COLUMN_WIDTH = 20
LABEL_WIDTH = 35
WORDS = {True: "yes", False: "NO", None: "?"}


def format_table(results: Results) -> str:
    """Return the report; "x0.50" next to a figure means that this library's value is half of the figure."""
    blocks = [_format_size(size, row) for size, row in results.items()]
    blocks += [
        _format_targets(size, row) for size, row in list(results.items())[-1:] if OURS in row or OURS_IN_MEMORY in row
    ]
    names = [name for name in LIBRARIES if any(name in row for row in results.values())]
    blocks.append("\n".join(f"{name}: a finished put means: {LIBRARIES[name].guarantee}" for name in names))
    return "\n\n".join(blocks) + "\n"


def _format_size(size: str, row: Mapping[str, Result]) -> str:
    mine = row.get(OURS) or row.get(OURS_IN_MEMORY) or {}
    lines = [f"N = {size}, one process a node, all on one machine"]
    lines.append(" " * LABEL_WIDTH + "".join(f"{name:>{COLUMN_WIDTH}}" for name in row))
    lines.append(
        f"{'behind the figures':{LABEL_WIDTH}}" + "".join(f"{LIBRARIES[name].storage:>{COLUMN_WIDTH}}" for name in row)
    )
    for label, read in ROWS:
        values = {name: read(result) for name, result in row.items()}
        if any(value is not None for value in values.values()):
            own = read(mine)
            cells = [_format_cell(value, None if row[name] is mine else own) for name, value in values.items()]
            lines.append(f"{label:{LABEL_WIDTH}}" + "".join(f"{cell:>{COLUMN_WIDTH}}" for cell in cells))
    for name, result in row.items():
        for part, phases in (("", result), *((f" ({loss})", result.get(loss, {})) for loss in ("killed", "silent"))):
            lines += [f"{name}{part}: {phase}: {why}" for phase, why in phases.get("trouble", {}).items()]
            lines += [f"{name}: {what} skipped: {why}" for what, why in phases.get("skipped", {}).items()]
    return "\n".join(lines)


def _format_cell(value: float | None, own: float | None) -> str:
    if value is None:
        return "-"
    shown = f"{value:.2f}" if abs(value) < 10 else f"{value:.1f}" if abs(value) < 100 else f"{value:,.0f}"
    return shown if own is None or not value else f"{shown} (x{own / value:.2f})"


def _format_targets(size: str, row: Mapping[str, Result]) -> str:
    head = f"Targets at N = {size}" + ("" if size == "32" else " (they are meant for 32)")
    lines = [head + ", our node sealed and with SQLite:" if OURS in row else head + ", our node sealed, in memory:"]
    for verdict in check_targets(row):
        limits = "; ".join(str(limit) for limit in verdict.limits)
        lines.append(f"{verdict.number:4} {WORDS[verdict.is_met]:4} {verdict.title:30}{limits}")
    return "\n".join(lines)
