"""Plot: the cost of each strategy against the optimum, a block of bars for each size, in one SVG without a library."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from typing import Any

WIDTH, NAME, BAR, HIGH = 760, 170, 470, 18
CALM, AFTER = "#2563a8", "#d08a2e"


def drawn(rows: Sequence[dict[str, Any]]) -> str:
    """The picture: how much more than the optimum each costs, before and after some agents failed."""
    parts: list[str] = []
    y = 16

    def text(x: float, words: str, more: str = "") -> None:
        parts.append(f'<text x="{x:.1f}" y="{y + 4}"{more}>{escape(words)}</text>')

    most = max(max(row["ratio"], row["ratio_failed"]) for row in rows) - 1.0 or 1.0
    text(8, "Cost above the optimum; orange: after a tenth of the agents has failed", ' font-weight="bold"')
    for size in sorted({row["agents"] for row in rows}):
        y += 2 * HIGH
        text(8, f"{size} agents, {size} tasks", ' font-weight="bold"')
        for row in (row for row in rows if row["agents"] == size):
            y += HIGH
            text(NAME - 8, row["strategy"], ' text-anchor="end"')
            for key, colour, up in (("ratio", CALM, 8), ("ratio_failed", AFTER, 0)):
                long = max(1.0, BAR * (row[key] - 1.0) / most)
                parts.append(f'<rect x="{NAME}" y="{y - up}" width="{long:.1f}" height="7" fill="{colour}"/>')
            text(NAME + BAR * (max(row["ratio"], row["ratio_failed"]) - 1.0) / most + 8, f"{row['ratio']:.3f}")
    body = "\n".join(parts)
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{WIDTH}" height="{y + 20}" font-family="sans-serif"'
        f' font-size="12">\n<rect width="100%" height="100%" fill="white"/>\n{body}\n</svg>\n'
    )
