"""Draw the curves as SVG over the number of nodes, with logarithmic axes where the values permit. Pure."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from html import escape

from sim.team.metric import format_number
from sim.team.scale.curve import Curve

Points = Sequence[tuple[int, float]]

WIDE, HIGH = 380, 250
LEFT, TOP, RIGHT, BOTTOM = 52, 44, 16, 46
COLUMNS = 3
OURS, THEORY, OTHERS, BOUND = "#2563a8", "#6b7280", "#c2410c", "#15803d"
EDGE_PIXELS = 12
"""Horizontal space for the last label of the rightmost plots."""
SMALLEST, LARGEST = 3, 10_000
MAX_LINEAR_RATIO = 8.0
"""Maximum ratio of the largest to the smallest value for a linear vertical axis."""


def draw_svg(curves: Sequence[Curve], points: Mapping[str, Points], note: str) -> str:
    """Return a plot of every curve that has points; ``note`` is written below the plots."""
    present = [curve for curve in curves if points.get(curve.metric)]
    rows = math.ceil(len(present) / COLUMNS)
    parts = []
    for number, curve in enumerate(present):
        x, y = WIDE * (number % COLUMNS), HIGH * (number // COLUMNS)
        parts.append(f'<g transform="translate({x} {y})">\n{_draw_plot(curve, points[curve.metric])}\n</g>')
    high = HIGH * rows + 44
    legend = [
        (OURS, "measured: the shipped nodes, simulated"),
        (THEORY, "theory, or our own simulation of it"),
        (OTHERS, "published by others"),
        (BOUND, "target"),
    ]
    for number, (colour, says) in enumerate(legend):
        x = 12 + 250 * number
        parts.append(f'<circle cx="{x}" cy="{high - 30}" r="4" fill="{colour}"/>')
        parts.append(f'<text x="{x + 8}" y="{high - 26}">{escape(says)}</text>')
    parts.append(f'<text x="8" y="{high - 8}" fill="#444">{escape(note)}</text>')
    body = "\n".join(parts)
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{WIDE * COLUMNS + EDGE_PIXELS}" height="{high}"'
        f' font-family="sans-serif" font-size="11">\n<rect width="100%" height="100%" fill="white"/>\n{body}\n</svg>\n'
    )


class _Axis:
    """A linear or logarithmic mapping from values to pixels."""

    def __init__(self, low: float, high: float, first: float, last: float, is_log: bool) -> None:
        self.is_log = is_log
        self._low, self._high = (math.log(low), math.log(high)) if is_log else (low, high)
        self._first, self._last = first, last

    def to_pixel(self, value: float) -> float:
        """Return the pixel of a value."""
        part = ((math.log(value) if self.is_log else value) - self._low) / ((self._high - self._low) or 1.0)
        return self._first + part * (self._last - self._first)


def _draw_plot(curve: Curve, points: Points) -> str:
    across = _Axis(SMALLEST, LARGEST, LEFT, WIDE - RIGHT, is_log=True)
    sizes = [n for n, _ in points]
    guided = [(n, curve.theory(n)) for n in _list_sizes(min(sizes), LARGEST)] if curve.theory else []
    bounds = [(n, bound.value) for n in sizes if (bound := curve.get_target(n)) is not None]
    others = [(one.nodes, one.value) for one in curve.published]
    values = [value for _, value in (*points, *guided, *bounds, *others)]
    low, high = min(values), max(values)
    is_log = low > 0 and high / low > MAX_LINEAR_RATIO
    if is_log:
        low, high = low / 1.3, high * 1.3
    else:
        low, high = (0.0 if low < 0.9 * high else low - 0.05 * high), high * 1.1 or 1.0
    up = _Axis(low, high, HIGH - BOTTOM, TOP, is_log)

    def line(some: Points, colour: str, dash: str = "") -> str:
        path = " ".join(f"{across.to_pixel(n):.1f},{up.to_pixel(value):.1f}" for n, value in some)
        return f'<polyline points="{path}" fill="none" stroke="{colour}" stroke-width="1.6"{dash}/>'

    unit = f"{curve.unit} · {curve.theory_label}" if curve.theory_label else curve.unit
    parts = [
        f'<text x="8" y="14" font-weight="bold">{escape(curve.title)}</text>',
        f'<text x="8" y="28" fill="#444">{escape(unit)}</text>',
        f'<path d="M{LEFT} {TOP}V{HIGH - BOTTOM}H{WIDE - RIGHT}" fill="none" stroke="#333"/>',
    ]
    for n in (3, 10, 30, 100, 300, 1000, 3000, 10_000):
        parts.append(f'<text x="{across.to_pixel(n):.0f}" y="{HIGH - BOTTOM + 13}" text-anchor="middle">{n:,}</text>')
    for value in _list_ticks(low, high, is_log):
        y = up.to_pixel(value)
        parts.append(f'<line x1="{LEFT}" y1="{y:.1f}" x2="{WIDE - RIGHT}" y2="{y:.1f}" stroke="#e5e7eb"/>')
        parts.append(f'<text x="{LEFT - 4}" y="{y + 4:.1f}" text-anchor="end">{format_number(value)}</text>')
    if bounds:
        parts.append(line(bounds, BOUND, ' stroke-dasharray="2 3"'))
    if guided:
        parts.append(line(guided, THEORY, ' stroke-dasharray="6 4"'))
    parts.append(line(points, OURS))
    for n, value in points:
        y = up.to_pixel(value)
        parts.append(
            f'<circle cx="{across.to_pixel(n):.1f}" cy="{y:.1f}" r="3" fill="{OURS}">'
            f"<title>{format_number(value)}</title></circle>"
        )
    for number, one in enumerate(curve.published):
        x, y = across.to_pixel(one.nodes), up.to_pixel(one.value)
        parts.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3.5" fill="{OTHERS}"/>')
        at = HIGH - 18 + 12 * number
        parts.append(
            f'<text x="8" y="{at}" fill="{OTHERS}">'
            f"{format_number(one.value)} at {one.nodes:,}: {escape(one.source)}</text>"
        )
    return "\n".join(parts)


def _list_sizes(low: int, high: int) -> list[int]:
    """Return sizes from ``low`` to ``high``, each a quarter larger than the previous one."""
    found, n = [], float(low)
    while n < high:
        found.append(round(n))
        n *= 1.25
    return [*found, high]


def _list_ticks(low: float, high: float, is_log: bool) -> list[float]:
    """Return round values between ``low`` and ``high``, for the labels of an axis."""
    if is_log:
        first, last = math.floor(math.log10(low)), math.ceil(math.log10(high))
        steps = (1, 3) if last - first <= 4 else (1,)
        found = [step * 10.0**power for power in range(first, last + 1) for step in steps]
    else:
        step = 10.0 ** math.floor(math.log10(high - low))
        while (high - low) / step < 3:
            step /= 2
        found = [step * number for number in range(math.floor(low / step), math.ceil(high / step) + 1)]
    return [value for value in found if low <= value <= high]
