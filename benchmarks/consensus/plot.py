"""Draw the cost of each strategy relative to the optimum, a block of bars for each size, as SVG without a library."""

from __future__ import annotations

import math
from collections.abc import Sequence
from html import escape
from typing import Any

WIDTH, NAME, BAR, HIGH = 795, 205, 470, 18
STEP = 0.1
CALM, AFTER, GRID = "#2563a8", "#d08a2e", "#dddddd"
END, BOLD = ' text-anchor="end"', ' font-weight="bold"'


def draw_svg(rows: Sequence[dict[str, Any]]) -> str:
    """Return the picture: the excess of each strategy over the optimum, before and after failures of agents."""
    parts: list[str] = []
    y = 16
    steps = max(1, math.ceil(max(max(row["ratio"], row["ratio_failed"]) - 1.0 for row in rows) / STEP - 1e-9))

    def text(x: float, words: str, more: str = "") -> None:
        parts.append(f'<text x="{x:.1f}" y="{y + 4}"{more}>{escape(words)}</text>')

    def bar(x: float, top: int, long: float, colour: str) -> None:
        parts.append(f'<rect x="{x:.1f}" y="{top}" width="{long:.1f}" height="7" fill="{colour}"/>')

    text(8, "Cost above the optimum, the mean of all missions", BOLD)
    y += HIGH
    for x, colour, words in ((8, CALM, "of the whole team"), (160, AFTER, "after a tenth of the agents has failed")):
        bar(x, y - 4, 14, colour)
        text(x + 20, words)
    for size in sorted({row["agents"] for row in rows}):
        block = [row for row in rows if row["agents"] == size]
        y += 2 * HIGH
        text(8, f"{size:,} agents, {size:,} tasks", BOLD)
        high = HIGH * len(block)
        for step in range(steps + 1):
            x = NAME + BAR * step / steps
            parts.append(f'<path d="M{x:.1f} {y + 8}v{high + 2}" stroke="{GRID}"/>')
            text(x, f"{100 * STEP * step:.0f} %", ' text-anchor="middle" font-size="10" fill="#666666"')
        for row in block:
            y += HIGH
            text(NAME - 8, row["strategy"], END)
            for key, colour, up in (("ratio", CALM, 8), ("ratio_failed", AFTER, 0)):
                bar(NAME, y - up, max(1.0, BAR * (row[key] - 1.0) / (STEP * steps)), colour)
            text(WIDTH - 62, f"{row['ratio']:.3f}", f'{END} fill="{CALM}"')
            text(WIDTH - 8, f"{row['ratio_failed']:.3f}", f'{END} fill="{AFTER}"')
    content = "\n".join(parts)
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{WIDTH}" height="{y + 20}" font-family="sans-serif"'
        f' font-size="12">\n<rect width="100%" height="100%" fill="white"/>\n{content}\n</svg>\n'
    )
