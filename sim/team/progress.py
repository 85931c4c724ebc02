"""Show the progress of a run, as a bar on a terminal and as lines elsewhere."""

from __future__ import annotations

from collections.abc import Callable
from typing import TextIO

from sim.team.metric import format_number
from sim.team.run import Run

BAR_WIDTH = 24
OFTEN, RARELY = 0.2, 10.0
"""Seconds between two updates on a terminal, and between two lines elsewhere."""
METRICS_INTERVAL_S = 2.0
"""Seconds between two evaluations of the workloads' figures, some of which are expensive."""


class Progress:
    """Writes the progress of a run to ``out``; ``seconds`` returns real time, ``resident`` bytes of memory.

    ``columns`` is the width of the terminal, 0 without one.
    """

    def __init__(self, out: TextIO, columns: int, seconds: Callable[[], float], resident: Callable[[], int]) -> None:
        self._out = out
        self._columns = columns
        self._seconds = seconds
        self._resident = resident
        self._last: tuple[float, float] | None = None
        self._width = 0
        self._metrics = ""
        self._metrics_at = float("-inf")

    def update(self, run: Run) -> None:
        """Show the progress, unless it was shown recently."""
        now, moment = self._seconds(), run.team.clock.seconds()
        if self._last is None:
            self._last = now, moment
            return
        before, then = self._last
        if now - before < (OFTEN if self._columns else RARELY):
            return
        self._last = now, moment
        if run.began_at is not None and now - self._metrics_at >= METRICS_INTERVAL_S:
            self._metrics_at = now
            self._metrics = "".join(
                f", {metric.name} {format_number(metric.value)}{'' if metric.holds else ' (!)'}"
                for metric in run.collect_metrics()
                if metric.target and metric.value is not None
            )
        self._write(self.format_line(run, (moment - then) / (now - before)))

    def format_line(self, run: Run, pace: float) -> str:
        """Return the progress as one line, with the figures that have targets; missed targets are marked.

        ``pace`` is the speed relative to real time.
        """
        team, moment, end = run.team, run.team.clock.seconds(), run.expected_end
        share = min(1.0, moment / end) if end else 0.0
        done = round(BAR_WIDTH * share)
        bar = f"[{'#' * done}{'.' * (BAR_WIDTH - done)}] " if self._columns else ""
        alive, inside = len(team.living), len(team.get_joined())
        who = f"{alive:,} alive" + (f", {alive - inside:,} of them not in" if alive != inside else "")
        sent = team.switchboard.counters["sent"]
        memory = f", {self._resident() / 2**20:,.0f} MiB" if self._resident() else ""
        return (
            f"{bar}{share:4.0%} {run.phase}, {moment:.1f} of {end:.0f} s, {who}, {sent:,} datagrams, "
            f"{pace:.2g} x real time{memory}{self._metrics}"
        )

    def close(self) -> None:
        """Clear the line on the terminal."""
        if self._width:
            self._out.write("\r" + " " * self._width + "\r")
            self._out.flush()
            self._width = 0

    def _write(self, line: str) -> None:
        if self._columns:
            line = line[: self._columns - 1]
            self._out.write("\r" + line.ljust(self._width))
            self._width = len(line)
        else:
            self._out.write(line + "\n")
        self._out.flush()
