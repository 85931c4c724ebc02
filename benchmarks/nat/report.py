"""Format the results of a run as tables for a terminal and for the documentation, and as a picture; pure."""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence
from html import escape

from benchmarks.nat.outcome import (
    ALONE,
    FORGOTTEN,
    LOSS,
    MATRIX,
    PLAIN,
    RENUMBERED,
    Outcome,
    check_requirements,
    format_cell,
)

MATRIX_PARTS = (PLAIN, LOSS, FORGOTTEN, RENUMBERED)
"""The parts that run every pair."""
BEGIN, END = "<!-- measured -->", "<!-- /measured -->"
LEFT, TOP, WIDE, HIGH = 150, 46, 112, 52
COLOURS = {"direct": "#cfe8d5", "relayed": "#fbe7b2", "tunnel": "#cfdcf2", "": "#f3c6c0"}
INK, FAINT = "#1d2733", "#5b6672"


def make_matrix_rows(outcomes: Sequence[Outcome], part: str) -> list[list[str]]:
    """Return the matrix of one part: a row for each kind, with a cell for each pair; the lower half is empty."""
    some = [one for one in outcomes if one.part == part]
    found = [[part, *(kind.value for kind in MATRIX)]]
    for number, a in enumerate(MATRIX):
        pairs = [
            format_cell([one for one in some if {one.a, one.b} == {a.value, b.value}]) if place >= number else ""
            for place, b in enumerate(MATRIX)
        ]
        found.append([a.value, *pairs])
    return found


def make_other_rows(outcomes: Sequence[Outcome]) -> list[list[str]]:
    """Return the rows of the special cases: in each part of the run without a matrix, a row for each pair."""
    found: list[list[str]] = []
    for part in dict.fromkeys(one.part for one in outcomes if one.part not in (*MATRIX_PARTS, ALONE)):
        some = [one for one in outcomes if one.part == part]
        for a, b, note in dict.fromkeys((one.a, one.b, one.note) for one in some):
            these = [one for one in some if (one.a, one.b, one.note) == (a, b, note)]
            found.append([part, f"{a} x {b}" + (f", {note}" if note else ""), format_cell(these)])
    return found


def format_table(outcomes: Sequence[Outcome]) -> str:
    """Return the complete report for a terminal."""
    parts = [_align(make_matrix_rows(outcomes, part)) for part in _measured_parts(outcomes)]
    parts += [_align(make_other_rows(outcomes))]
    parts += [
        "\n".join(f"{'met    ' if p.is_kept else 'NOT MET'}  {p.what}: {p.seen}" for p in check_requirements(outcomes))
    ]
    troubles = dict.fromkeys(f"{one.part} {one.a} x {one.b}: {one.trouble}" for one in outcomes if one.trouble)
    parts += ["\n".join(list(troubles)[:12])]
    later = [one for one in outcomes if one.later and one.later != one.path and one.seconds < math.inf]
    if later:
        parts.append(f"{len(later)} pairs used another path at the end: {later[0].path} to {later[0].later}")
    return "\n\n".join(part for part in parts if part)


def update_document(document: str, outcomes: Sequence[Outcome]) -> str:
    """Return ``document`` with the results between its two marks; raise ``ValueError`` if the marks are missing."""
    before, begin, rest = document.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not begin or not end:
        raise ValueError(f"the document has no marks {BEGIN} and {END}")
    lines = [BEGIN, ""]
    for part in _measured_parts(outcomes):
        head, *body = make_matrix_rows(outcomes, part)
        lines += [*_format_markdown(head, body), ""]
    kept = [[p.what, p.seen, "met" if p.is_kept else "**not met**"] for p in check_requirements(outcomes)]
    lines += _format_markdown(["requirement", "result", ""], kept)
    lines += ["", *_format_markdown(["case", "pair", "result"], make_other_rows(outcomes)), "", END]
    return before + "\n".join(lines) + after


def _measured_parts(outcomes: Sequence[Outcome]) -> list[str]:
    return [part for part in MATRIX_PARTS if any(one.part == part for one in outcomes)]


def _format_markdown(head: list[str], body: list[list[str]]) -> list[str]:
    return [_format_row(head), _format_row(["---"] * len(head)), *(_format_row(row) for row in body)]


def _format_row(cells: list[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def _align(lines: list[list[str]]) -> str:
    if not lines:
        return ""
    widths = [max(len(line[column]) for line in lines) for column in range(len(lines[0]))]
    return "\n".join("  ".join(f"{c:<{w}}" for c, w in zip(line, widths, strict=True)).rstrip() for line in lines)


def draw_svg(outcomes: Sequence[Outcome], title: str) -> str:
    """Return the matrix as an SVG: a square for each pair with the path and the median of the seconds."""
    width, height = LEFT + WIDE * len(MATRIX) + 16, TOP + HIGH * len(MATRIX) + 60
    parts = [f'<text x="12" y="22" font-size="15" font-weight="bold">{escape(title)}</text>']
    for number, kind in enumerate(MATRIX):
        x, y = LEFT + number * WIDE + WIDE / 2, TOP + number * HIGH + HIGH / 2
        parts.append(f'<text x="{x:g}" y="{TOP - 6}" text-anchor="middle">{escape(kind.description)}</text>')
        parts.append(f'<text x="{LEFT - 10}" y="{y + 4:g}" text-anchor="end">{escape(kind.description)}</text>')
    for row, a in enumerate(MATRIX):
        for column, b in enumerate(MATRIX[row:], start=row):
            some = [one for one in outcomes if {one.a, one.b} == {a.value, b.value}]
            if some:
                parts += _draw_square(LEFT + column * WIDE, TOP + row * HIGH, some)
    y = height - 28
    for number, (path, colour) in enumerate(COLOURS.items()):
        x = LEFT + number * 130
        parts.append(f'<rect x="{x}" y="{y - 11}" width="14" height="14" fill="{colour}"/>')
        parts.append(f'<text x="{x + 20}" y="{y}">{path or "no answer"}</text>')
    content = "\n".join(parts)
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}" height="{height}" font-family="sans-serif"'
        f' font-size="12" fill="{INK}">\n<rect width="100%" height="100%" fill="white"/>\n{content}\n</svg>\n'
    )


def _draw_square(x: float, y: float, some: Sequence[Outcome]) -> list[str]:
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
