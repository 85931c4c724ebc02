"""Define the figures that a run measures, and their targets.  Pure.

A rate includes the number of trials: no event in n trials means a rate below 3/n with a confidence of 95 %.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace

ZERO_EVENTS_FACTOR = 3.0
"""Upper bound of the expected number of events, with 95 % confidence, if no event was seen (the rule of three)."""
_BOUND = re.compile(r"\s*(<=|>=)\s*(\S+)\s*")


@dataclass(frozen=True)
class Bound:
    """A bound of a figure: a maximum if ``is_maximum``, else a minimum."""

    value: float
    is_maximum: bool = True

    def is_met(self, value: float) -> bool:
        """Return whether ``value`` is within the bound; False for NaN."""
        return value <= self.value if self.is_maximum else value >= self.value

    def __str__(self) -> str:
        return f"{'<=' if self.is_maximum else '>='} {format_number(self.value)}"


def parse_bound(text: str) -> Bound:
    """Parse a bound such as ``"<= 450"`` or ``">= 0.999"``; raises ``ValueError`` for anything else."""
    match = _BOUND.fullmatch(text)
    if match is None or not math.isfinite(value := float(match[2])):
        raise ValueError(f"{text!r} is not a bound: write '<= 450' or '>= 0.999'")
    return Bound(value, match[1] == "<=")


@dataclass(frozen=True)
class Metric:
    """A measured ``value`` in ``unit``; None if nothing was measured.

    ``target`` is the target as text, or empty; ``holds`` is whether the target is met, None if there is no target.
    ``n`` is the number of trials, 0 if the figure has no trials. ``is_exact`` is whether the value follows from the
    seed, unlike time and memory of the machine that runs the simulation.
    """

    name: str
    value: float | None
    unit: str = ""
    target: str = ""
    holds: bool | None = None
    n: int = 0
    is_exact: bool = True

    def with_target(self, bound: Bound | None) -> Metric:
        """Return this figure with ``bound`` as target; a figure without a value misses every target."""
        if bound is None:
            return self
        return replace(self, target=str(bound), holds=self.value is not None and bound.is_met(self.value))

    def to_json(self) -> dict[str, object]:
        """Return the figure for JSON, with None for infinity."""
        content = asdict(self)
        if self.value is not None and not math.isfinite(self.value):
            content["value"] = None
        return content


def make_maximum(name: str, value: float | None, unit: str, bound: float, n: int = 0) -> Metric:
    """Return a figure with a maximum."""
    return Metric(name, value, unit, n=n).with_target(Bound(bound))


def make_minimum(name: str, value: float | None, unit: str, bound: float, n: int = 0) -> Metric:
    """Return a figure with a minimum."""
    return Metric(name, value, unit, n=n).with_target(Bound(bound, is_maximum=False))


def make_share(name: str, good: int, n: int) -> Metric:
    """Return the share of successes among ``n`` trials, from 0 to 1."""
    return Metric(name, good / n if n else None, "share", n=n)


def percentile(values: Sequence[float], part: float) -> float | None:
    """Return the smallest of ``values`` that at least the share ``part`` of them does not exceed; None if empty."""
    ordered = sorted(values)
    return ordered[max(0, math.ceil(part * len(ordered)) - 1)] if ordered else None


def mean(values: Sequence[float]) -> float | None:
    """Return the mean; None without values."""
    return math.fsum(values) / len(values) if values else None


def make_percentiles(
    name: str, values: Sequence[float], unit: str, parts: Sequence[float] = (0.5, 0.99)
) -> list[Metric]:
    """Return the percentiles ``parts`` of ``values``, and the maximum, as figures ``name.p50`` and so on."""
    found = [Metric(f"{name}.p{100 * part:g}", percentile(values, part), unit, n=len(values)) for part in parts]
    return [*found, Metric(f"{name}.max", max(values, default=None), unit, n=len(values))]


def format_number(value: float | None) -> str:
    """Format a number with four significant digits."""
    if value is None:
        return "-"
    if not math.isfinite(value):
        return "never"
    if value == 0 or abs(value) >= 1000:
        return f"{value:,.0f}"
    return f"{value:.4g}" if abs(value) >= 1e-3 else f"{value:.1e}"


def format_trials(figure: Metric) -> str:
    """Return the number of trials as text, with the bound that it implies for a share of 0 or 1."""
    if figure.unit == "share" and figure.n and figure.value in (0.0, 1.0):
        limit = format_number(ZERO_EVENTS_FACTOR / figure.n)
        return f"n {figure.n:,}, < {limit} {'else' if figure.value else ''}".rstrip()
    return f"n {figure.n:,}" if figure.n else ""


WORDS = {True: "yes", False: "NO", None: ""}


def format_table(figures: Iterable[Metric]) -> str:
    """Return one line per figure: name, value, unit, target, whether it is met, and the trials."""
    rows = [(f.name, format_number(f.value), f.unit, f.target, WORDS[f.holds], format_trials(f)) for f in figures]
    wide = [max((len(row[column]) for row in rows), default=0) for column in range(6)]
    lines = [
        f"{name:<{wide[0]}}  {value:>{wide[1]}} {unit:<{wide[2]}}  {target:<{wide[3]}}  {word:<{wide[4]}}  {note}"
        for name, value, unit, target, word, note in rows
    ]
    return "\n".join(line.rstrip() for line in lines)
