"""Draw the main figures as horizontal bars in one SVG, without a library."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape

from benchmarks.dht.library import LIBRARIES
from benchmarks.dht.rows import ROWS, Result

SHOWN_ROWS = (
    "join, first old key read, ms",
    "put p50, ms",
    "get p50, ms",
    "remote get p50, ms",
    "gets/s, 32 in flight",
    "puts/s, 32 in flight",
    "datagrams a put",
    "datagrams a remote get",
    "CPU ms a put, all nodes",
    "CPU ms a get, all nodes",
    "RSS a node, MiB",
    "a half silent: p95, ms",
)
WIDTH, NAME, BAR, HIGH, GAP = 760, 150, 490, 18, 14
OWN, OTHER = "#2563a8", "#9aa3ad"


def draw_svg(results: Mapping[str, Mapping[str, Result]]) -> str:
    """Return the picture: a block for each figure and size; each block has a separate scale."""
    reads = dict(ROWS)
    parts: list[str] = []
    y = 10

    def text(x: float, words: str, more: str = "") -> None:
        parts.append(f'<text x="{x:.1f}" y="{y + 4}"{more}>{escape(words)}</text>')

    for size, row in results.items():
        for label in SHOWN_ROWS:
            values = {name: value for name in row if (value := reads[label](row[name])) is not None}
            if not values:
                continue
            y += GAP
            text(8, f"N = {size}: {label}", ' font-weight="bold"')
            most = max(values.values()) or 1.0
            for name, value in values.items():
                y += HIGH
                long = max(1.0, BAR * value / most)
                text(NAME - 8, name, ' text-anchor="end"')
                colour = OWN if name.startswith("swarm") else OTHER
                parts.append(f'<rect x="{NAME}" y="{y - 7}" width="{long:.1f}" height="{HIGH - 4}" fill="{colour}"/>')
                text(NAME + long + 6, f"{value:,.2f}" if value < 100 else f"{value:,.0f}")
            y += HIGH
    for name in [name for name in LIBRARIES if any(name in row for row in results.values())]:
        y += HIGH
        text(8, f"{name}: {LIBRARIES[name].storage}; a finished put means: {LIBRARIES[name].guarantee}")
    body = "\n".join(parts)
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{WIDTH}" height="{y + 16}" font-family="sans-serif"'
        f' font-size="12">\n<rect width="100%" height="100%" fill="white"/>\n{body}\n</svg>\n'
    )
