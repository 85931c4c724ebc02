"""Write the curves as a table in Markdown, with an extrapolation.  Pure."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from sim.team.figure import shown
from sim.team.scale.curve import Curve
from sim.team.scale.drawing import Points

MILLION = 1_000_000
FROM = 100
"""Number of nodes from which on sizes are used for the extrapolation; below, every node knows all others."""
LEAST = 3
"""Minimum number of sizes for the extrapolation."""


def led(points: Points, nodes: int = MILLION) -> float | None:
    """Extrapolate ``points`` to ``nodes`` by linear regression over log2 n; None for too few points."""
    some = [(math.log2(n), value) for n, value in points if n >= FROM]
    if len(some) < LEAST:
        return None
    x0 = math.fsum(x for x, _ in some) / len(some)
    y0 = math.fsum(y for _, y in some) / len(some)
    slope = math.fsum((x - x0) * (y - y0) for x, y in some) / math.fsum((x - x0) ** 2 for x, _ in some)
    return y0 + slope * (math.log2(nodes) - x0)


def page(curves: Sequence[Curve], points: Mapping[str, Points]) -> str:
    """Return a table with one row per curve and one column per size; values that miss their targets are bold."""
    present = [curve for curve in curves if points.get(curve.figure)]
    sizes = sorted({n for curve in present for n, _ in points[curve.figure]})
    lines = [
        "Written by `sim scale`. **Bold**: beyond the target of that size. The last column goes on straight over",
        f"log2 n from the sizes of {FROM} and more; it is no measurement.",
        "",
        "| figure | unit | " + " | ".join(f"{n:,}" for n in sizes) + f" | target | ({MILLION:,}) |",
        "|---|---|" + "---|" * (len(sizes) + 2),
    ]
    for curve in present:
        values = dict(points[curve.figure])
        cells = []
        for n in sizes:
            value, bound = values.get(n), curve.target(n)
            text = shown(value)
            cells.append(f"**{text}**" if value is not None and bound is not None and not bound.holds(value) else text)
        target, far = curve.target(sizes[-1]), led(points[curve.figure])
        goes_on = "" if far is None or curve.unit == "share" else shown(far)
        own = [f"{bound} at {n:,}" for n, bound in curve.at if n in sizes and bound != target]
        wanted = "; ".join(filter(None, [str(target or ""), ", ".join(own)]))
        row = [curve.title.replace("|", "/"), curve.unit, *cells, wanted, goes_on]
        lines.append("| " + " | ".join(row) + " |")
    return "\n".join(lines) + "\n"
