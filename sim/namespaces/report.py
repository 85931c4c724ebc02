"""Report: the table of a run, for a terminal and for the documents; pure."""

from __future__ import annotations

import math
from collections.abc import Sequence

from sim.namespaces.outcome import ALONE, FORGOTTEN, LOSS, MATRIX, PLAIN, RENUMBERED, Outcome, cell, promises

WHOLE = (PLAIN, LOSS, FORGOTTEN, RENUMBERED)
"""The parts in which every pair is tried."""
BEGIN, END = "<!-- measured -->", "<!-- /measured -->"


def rows(outcomes: Sequence[Outcome], part: str) -> list[list[str]]:
    """The matrix of one part: a row for each kind, with a word for each pair; the lower half is empty."""
    some = [one for one in outcomes if one.part == part]
    found = [[part, *(kind.value for kind in MATRIX)]]
    for number, a in enumerate(MATRIX):
        pairs = [
            cell([one for one in some if {one.a, one.b} == {a.value, b.value}]) if place >= number else ""
            for place, b in enumerate(MATRIX)
        ]
        found.append([a.value, *pairs])
    return found


def others(outcomes: Sequence[Outcome]) -> list[list[str]]:
    """The special cases: a row for each pair of each other part."""
    found: list[list[str]] = []
    for part in dict.fromkeys(one.part for one in outcomes if one.part not in (*WHOLE, ALONE)):
        some = [one for one in outcomes if one.part == part]
        for a, b, note in dict.fromkeys((one.a, one.b, one.note) for one in some):
            these = [one for one in some if (one.a, one.b, one.note) == (a, b, note)]
            found.append([part, f"{a} x {b}" + (f", {note}" if note else ""), cell(these)])
    return found


def table(outcomes: Sequence[Outcome]) -> str:
    """The whole report for a terminal."""
    parts = [_aligned(rows(outcomes, part)) for part in _tried(outcomes)]
    parts += [_aligned(others(outcomes))]
    parts += ["\n".join(f"{'held  ' if p.is_kept else 'BROKEN'}  {p.what}: {p.seen}" for p in promises(outcomes))]
    troubles = dict.fromkeys(f"{one.part} {one.a} x {one.b}: {one.trouble}" for one in outcomes if one.trouble)
    parts += ["\n".join(list(troubles)[:12])]
    later = [one for one in outcomes if one.later and one.later != one.path and one.seconds < math.inf]
    if later:
        parts.append(f"{len(later)} pairs had changed their way by the end: {later[0].path} to {later[0].later}")
    return "\n\n".join(part for part in parts if part)


def written(document: str, outcomes: Sequence[Outcome]) -> str:
    """``document``, with what was measured between its two marks; raises ``ValueError`` where it has none."""
    before, begin, rest = document.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not begin or not end:
        raise ValueError(f"the document has no {BEGIN} .. {END}")
    lines = [BEGIN, ""]
    for part in _tried(outcomes):
        head, *body = rows(outcomes, part)
        lines += [*_markdown(head, body), ""]
    lines += [
        *_markdown(
            ["promise", "seen", ""],
            [[p.what, p.seen, "held" if p.is_kept else "**broken**"] for p in promises(outcomes)],
        ),
    ]
    lines += ["", *_markdown(["case", "pair", "seen"], others(outcomes)), "", END]
    return before + "\n".join(lines) + after


def _tried(outcomes: Sequence[Outcome]) -> list[str]:
    return [part for part in WHOLE if any(one.part == part for one in outcomes)]


def _markdown(head: list[str], body: list[list[str]]) -> list[str]:
    return [_line(head), _line(["---"] * len(head)), *(_line(row) for row in body)]


def _line(cells: list[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def _aligned(lines: list[list[str]]) -> str:
    if not lines:
        return ""
    widths = [max(len(line[column]) for line in lines) for column in range(len(lines[0]))]
    return "\n".join("  ".join(f"{c:<{w}}" for c, w in zip(line, widths, strict=True)).rstrip() for line in lines)
