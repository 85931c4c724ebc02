"""Draw a run's figures over time as SVG, one small diagram each."""

from __future__ import annotations

import math
from collections.abc import Sequence
from html import escape

from sim.team.report import Series

WIDE, HIGH, LEFT, TOP, GAP, COLUMNS = 360, 120, 62, 46, 46, 2
LINE, AXIS, FAULT = "#2563a8", "#6b7280", "#c2410c"


def draw_svg(title: str, series: Series, faults: Sequence[tuple[float, str]] = ()) -> str:
    """Return the SVG; ``faults`` are times and descriptions, drawn as vertical lines."""
    parts: list[str] = []
    shown = {name: points for name, points in series.items() if len(points) > 1}
    end = max((points[-1][0] for points in shown.values()), default=1.0) or 1.0
    for number, (name, points) in enumerate(shown.items()):
        x = LEFT + number % COLUMNS * (WIDE + LEFT + 20)
        y = TOP + number // COLUMNS * (HIGH + GAP)
        parts.append(_draw_diagram(x, y, name, points, end, faults))
    rows = math.ceil(len(shown) / COLUMNS)
    width, height = COLUMNS * (WIDE + LEFT + 20), TOP + max(1, rows) * (HIGH + GAP) + 10
    text = escape("; ".join(f"{moment:g} s {what}" for moment, what in faults) or "no faults")
    nothing = "" if shown else f'<text x="{LEFT}" y="{TOP + 20}">nothing was measured</text>'
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}" height="{height}" viewBox="0 0 {width} {height}" '
        f'font-family="sans-serif" font-size="11" role="img">\n<title>{escape(title)}</title>\n<desc>{text}</desc>\n'
        f'<rect width="100%" height="100%" fill="white"/>\n<text x="{LEFT}" y="20" font-size="14" font-weight="bold">'
        f"{escape(title)}</text>\n{nothing}" + "\n".join(parts) + "\n</svg>\n"
    )


def _draw_diagram(
    x: float,
    y: float,
    name: str,
    points: Sequence[tuple[float, float]],
    end: float,
    faults: Sequence[tuple[float, str]],
) -> str:
    finite = [value for _, value in points if math.isfinite(value)]
    least, most = min(0.0, min(finite, default=0.0)), max(finite, default=1.0)
    span = (most - least) or 1.0

    def place(moment: float, value: float) -> str:
        return f"{x + WIDE * moment / end:.1f},{y + HIGH - HIGH * (value - least) / span:.1f}"

    line = " ".join(place(moment, value) for moment, value in points if math.isfinite(value))
    marks = "".join(
        f'<line x1="{x + WIDE * moment / end:.1f}" x2="{x + WIDE * moment / end:.1f}" y1="{y}" y2="{y + HIGH}" '
        f'stroke="{FAULT}" stroke-dasharray="3 3"><title>{escape(what)}</title></line>'
        for moment, what in faults
        if moment <= end
    )
    return (
        f'<text x="{x}" y="{y - 6}" font-weight="bold">{escape(name)}</text>'
        f'<path d="M{x} {y}V{y + HIGH}H{x + WIDE}" fill="none" stroke="{AXIS}"/>'
        f'<text x="{x - 6}" y="{y + 9}" text-anchor="end">{_format_value(most)}</text>'
        f'<text x="{x - 6}" y="{y + HIGH}" text-anchor="end">{_format_value(least)}</text>'
        f'<text x="{x}" y="{y + HIGH + 14}">0</text>'
        f'<text x="{x + WIDE}" y="{y + HIGH + 14}" text-anchor="end">{end:g} s</text>'
        f'{marks}<polyline points="{line}" fill="none" stroke="{LINE}" stroke-width="1.5"/>'
    )


def _format_value(value: float) -> str:
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"
