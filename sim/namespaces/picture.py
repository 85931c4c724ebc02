"""Picture: the matrix as an SVG, without a library; pure."""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence
from html import escape

from sim.namespaces.outcome import MATRIX, Outcome

LEFT, TOP, WIDE, HIGH = 150, 46, 112, 52
COLOURS = {"direct": "#cfe8d5", "relayed": "#fbe7b2", "tunnel": "#cfdcf2", "": "#f3c6c0"}
INK, FAINT = "#1d2733", "#5b6672"


def drawn(outcomes: Sequence[Outcome], title: str) -> str:
    """A square for each pair: the way that was found, and the median seconds."""
    width, height = LEFT + WIDE * len(MATRIX) + 16, TOP + HIGH * len(MATRIX) + 60
    parts = [f'<text x="12" y="22" font-size="15" font-weight="bold">{escape(title)}</text>']
    for number, kind in enumerate(MATRIX):
        x, y = LEFT + number * WIDE + WIDE / 2, TOP + number * HIGH + HIGH / 2
        parts.append(f'<text x="{x:g}" y="{TOP - 6}" text-anchor="middle">{escape(kind.meaning)}</text>')
        parts.append(f'<text x="{LEFT - 10}" y="{y + 4:g}" text-anchor="end">{escape(kind.meaning)}</text>')
    for row, a in enumerate(MATRIX):
        for column, b in enumerate(MATRIX[row:], start=row):
            some = [one for one in outcomes if {one.a, one.b} == {a.value, b.value}]
            if some:
                parts += _square(LEFT + column * WIDE, TOP + row * HIGH, some)
    y = height - 28
    for number, (path, colour) in enumerate(COLOURS.items()):
        x = LEFT + number * 130
        parts.append(f'<rect x="{x}" y="{y - 11}" width="14" height="14" fill="{colour}"/>')
        parts.append(f'<text x="{x + 20}" y="{y}">{path or "no answer"}</text>')
    body = "\n".join(parts)
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}" height="{height}" font-family="sans-serif"'
        f' font-size="12" fill="{INK}">\n<rect width="100%" height="100%" fill="white"/>\n{body}\n</svg>\n'
    )


def _square(x: float, y: float, some: Sequence[Outcome]) -> list[str]:
    there = [one for one in some if one.seconds < math.inf]
    path = statistics.mode(one.path for one in there) if there else ""
    words = f"{statistics.median(one.seconds for one in there):.2f} s" if there else "fails"
    share = f"{len(there)} of {len(some)}"
    middle = x + WIDE / 2
    return [
        f'<rect x="{x + 2:g}" y="{y + 2:g}" width="{WIDE - 4}" height="{HIGH - 4}" rx="4" fill="{COLOURS.get(path)}"/>',
        f'<text x="{middle:g}" y="{y + 24:g}" text-anchor="middle" font-size="14">{words}</text>',
        f'<text x="{middle:g}" y="{y + 40:g}" text-anchor="middle" fill="{FAINT}">{share}</text>',
    ]
