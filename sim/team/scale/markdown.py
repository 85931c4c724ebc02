"""Write the curves as a table in Markdown, with an extrapolation.  Pure."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from sim.team.metric import format_number
from sim.team.scale.curve import Curve
from sim.team.scale.drawing import Points

MILLION = 1_000_000
MIN_FIT_NODES = 100
"""Minimum size that is used for the extrapolation; in smaller teams every node knows all others."""
MIN_FIT_SIZES = 3
"""Minimum number of sizes for the extrapolation."""


def extrapolate(points: Points, nodes: int = MILLION) -> float | None:
    """Extrapolate ``points`` to ``nodes`` by linear regression over log2 n; None for too few points."""
    some = [(math.log2(n), value) for n, value in points if n >= MIN_FIT_NODES]
    if len(some) < MIN_FIT_SIZES:
        return None
    x0 = math.fsum(x for x, _ in some) / len(some)
    y0 = math.fsum(y for _, y in some) / len(some)
    slope = math.fsum((x - x0) * (y - y0) for x, y in some) / math.fsum((x - x0) ** 2 for x, _ in some)
    return y0 + slope * (math.log2(nodes) - x0)


def format_markdown(curves: Sequence[Curve], points: Mapping[str, Points]) -> str:
    """Return a table with a row for each curve and a column for each size; values that miss their targets are bold."""
    present = [curve for curve in curves if points.get(curve.metric)]
    sizes = sorted({n for curve in present for n, _ in points[curve.metric]})
    lines = [
        "Written by `sim scale`. **Bold**: beyond the target of that size. The last column goes on straight over",
        f"log2 n from the sizes of {MIN_FIT_NODES} and more; it is no measurement.",
        "",
        "| figure | unit | " + " | ".join(f"{n:,}" for n in sizes) + f" | target | ({MILLION:,}) |",
        "|---|---|" + "---|" * (len(sizes) + 2),
    ]
    for curve in present:
        values = dict(points[curve.metric])
        cells = []
        for n in sizes:
            value, bound = values.get(n), curve.get_target(n)
            text = format_number(value)
            cells.append(f"**{text}**" if value is not None and bound is not None and not bound.is_met(value) else text)
        target, far = curve.get_target(sizes[-1]), extrapolate(points[curve.metric])
        goes_on = "" if far is None or curve.unit == "share" else format_number(far)
        own = [f"{bound} at {n:,}" for n, bound in curve.bounds_by_size if n in sizes and bound != target]
        wanted = "; ".join(filter(None, [str(target or ""), ", ".join(own)]))
        row = [curve.title.replace("|", "/"), curve.unit, *cells, wanted, goes_on]
        lines.append("| " + " | ".join(row) + " |")
    return "\n".join(lines) + "\n"
