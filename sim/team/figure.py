"""Figure: one number that a run came to, beside what was wanted of it; pure.

A rate is told with the number of trials behind it: nothing seen in n of them means less than 3/n at 95 %.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace

NONE_SEEN = 3.0
"""Events that nothing in n trials still leaves room for, with 95 % (the rule of three)."""
_BOUND = re.compile(r"\s*(<=|>=)\s*(\S+)\s*")


@dataclass(frozen=True)
class Bound:
    """What a figure must not be above (``most``), or else not below."""

    value: float
    most: bool = True

    def holds(self, value: float) -> bool:
        """Whether ``value`` is within; what is no number is not."""
        return value <= self.value if self.most else value >= self.value

    def __str__(self) -> str:
        return f"{'<=' if self.most else '>='} {shown(self.value)}"


def bound_of(text: str) -> Bound:
    """The bound in ``"<= 450"`` or ``">= 0.999"``; raises ``ValueError`` for anything else."""
    match = _BOUND.fullmatch(text)
    if match is None or not math.isfinite(value := float(match[2])):
        raise ValueError(f"{text!r} is no bound: write '<= 450' or '>= 0.999'")
    return Bound(value, match[1] == "<=")


@dataclass(frozen=True)
class Figure:
    """``value`` in ``unit``; None where nothing was measured.

    ``target`` is what was wanted, as people read it, or empty; ``holds`` whether it was reached, None without a target.
    ``n`` is how many trials are behind it, 0 where that says nothing.  ``is_exact``: the same seed gives the same
    value; the seconds and bytes of the machine that runs the simulation are none of these.
    """

    name: str
    value: float | None
    unit: str = ""
    target: str = ""
    holds: bool | None = None
    n: int = 0
    is_exact: bool = True

    def against(self, bound: Bound | None) -> Figure:
        """This figure held to ``bound``; what was not measured does not reach any."""
        if bound is None:
            return self
        return replace(self, target=str(bound), holds=self.value is not None and bound.holds(self.value))

    def packed(self) -> dict[str, object]:
        """The figure for JSON, which knows no infinity: None stands for it."""
        content = asdict(self)
        if self.value is not None and not math.isfinite(self.value):
            content["value"] = None
        return content


def at_most(name: str, value: float | None, unit: str, bound: float, n: int = 0) -> Figure:
    """A figure that is not to be above ``bound``."""
    return Figure(name, value, unit, n=n).against(Bound(bound))


def at_least(name: str, value: float | None, unit: str, bound: float, n: int = 0) -> Figure:
    """A figure that is not to be below ``bound``."""
    return Figure(name, value, unit, n=n).against(Bound(bound, most=False))


def share(name: str, good: int, n: int) -> Figure:
    """The share of ``n`` trials that were good, from 0 to 1."""
    return Figure(name, good / n if n else None, "share", n=n)


def percentile(values: Sequence[float], part: float) -> float | None:
    """The least of ``values`` that ``part`` of them do not exceed; None where there are none."""
    ordered = sorted(values)
    return ordered[max(0, math.ceil(part * len(ordered)) - 1)] if ordered else None


def mean(values: Sequence[float]) -> float | None:
    """The mean; None where there are no values."""
    return math.fsum(values) / len(values) if values else None


def spread(name: str, values: Sequence[float], unit: str, parts: Sequence[float] = (0.5, 0.99)) -> list[Figure]:
    """The percentiles ``parts`` of ``values``, and the largest, as figures ``name.p50`` and so on."""
    found = [Figure(f"{name}.p{100 * part:g}", percentile(values, part), unit, n=len(values)) for part in parts]
    return [*found, Figure(f"{name}.max", max(values, default=None), unit, n=len(values))]


def shown(value: float | None) -> str:
    """A number as people read it: four digits that count."""
    if value is None:
        return "-"
    if not math.isfinite(value):
        return "never"
    if value == 0 or abs(value) >= 1000:
        return f"{value:,.0f}"
    return f"{value:.4g}" if abs(value) >= 1e-3 else f"{value:.1e}"


def remark(figure: Figure) -> str:
    """What the number of trials says beyond the value."""
    if figure.unit == "share" and figure.n and figure.value in (0.0, 1.0):
        return f"n {figure.n:,}, < {shown(NONE_SEEN / figure.n)} {'else' if figure.value else ''}".rstrip()
    return f"n {figure.n:,}" if figure.n else ""


WORDS = {True: "yes", False: "NO", None: ""}


def table(figures: Iterable[Figure]) -> str:
    """One line a figure: name, value, unit, target, whether it is reached, and the trials behind it."""
    rows = [(f.name, shown(f.value), f.unit, f.target, WORDS[f.holds], remark(f)) for f in figures]
    wide = [max((len(row[column]) for row in rows), default=0) for column in range(6)]
    lines = [
        f"{name:<{wide[0]}}  {value:>{wide[1]}} {unit:<{wide[2]}}  {target:<{wide[3]}}  {word:<{wide[4]}}  {note}"
        for name, value, unit, target, word, note in rows
    ]
    return "\n".join(line.rstrip() for line in lines)
