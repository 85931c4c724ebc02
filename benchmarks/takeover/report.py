"""Format the causes as a table and as histograms."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

from benchmarks.takeover.cause import DESCRIPTIONS, Cause, Trial
from sim.demo.trials import percentile

TARGETS = {cause.value: (1.5, 2.0) for cause in Cause} | {Cause.POLITE_LEAVE.value: (0.2, 0.5)}
"""Seconds for 50 % and 99 % of the takeovers (consensus targets; reliability target for the graceful leave)."""
BIN_S, MOST_S = 0.1, 4.0
WIDE, HIGH, LEFT = 12, 60, 150


def format_table(trials: Sequence[Trial]) -> str:
    """Return a line for each cause: passed trials, takeover times, and samples with two moving robots or a zombie."""
    lines = [
        f"{'':16}{'trials':>7}{'held':>6}{'p50 s':>8}{'p95 s':>8}{'p99 s':>8}{'max s':>8}"
        f"{'two':>5}{'zombie':>8}  target"
    ]
    for cause in Cause:
        some = [trial for trial in trials if trial.cause == cause.value]
        if not some:
            continue
        times = [trial.takeover for trial in some if trial.takeover is not None]
        shares = [percentile(times, share) for share in (0.5, 0.95, 0.99, 1.0)] if times else []
        cells = "".join(f"{value:8.2f}" for value in shares) or f"{'-':>8}" * 4
        p50, p99 = TARGETS[cause.value]
        reached = bool(shares) and shares[0] <= p50 and shares[2] <= p99
        held = sum(trial.has_passed for trial in some)
        bad = f"{sum(t.overlaps for t in some):>5}{sum(t.zombies for t in some):>8}"
        verdict = f"p50 {p50:g}, p99 {p99:g}: {'yes' if reached else 'no'}"
        lines.append(f"{cause.value:16}{len(some):>7}{held:>6}{cells}{bad}  {verdict}")
    return "\n".join(lines)


def draw_svg(trials: Sequence[Trial]) -> str:
    """Return a histogram for each cause, in one SVG: tenths of a second to the right, trials upwards."""
    bins = round(MOST_S / BIN_S)
    parts, y = [], 10
    for cause in Cause:
        times = [t.takeover for t in trials if t.cause == cause.value and t.takeover is not None]
        if not times:
            continue
        counts = [0] * (bins + 1)
        for seconds in times:
            counts[min(bins, int(seconds / BIN_S))] += 1
        parts.append(f'<text x="8" y="{y + 14}" font-weight="bold">{escape(cause.value)}</text>')
        parts.append(f'<text x="{LEFT}" y="{y + 14}">{escape(DESCRIPTIONS[cause])}</text>')
        y += HIGH + 22
        for place, count in enumerate(counts):
            high = HIGH * count / max(counts)
            x = LEFT + place * WIDE
            parts.append(f'<rect x="{x}" y="{y - high:.1f}" width="{WIDE - 1}" height="{high:.1f}" fill="#2563a8"/>')
        middle = LEFT + percentile(times, 0.5) / BIN_S * WIDE
        parts.append(f'<line x1="{middle:.1f}" y1="{y - HIGH}" x2="{middle:.1f}" y2="{y}" stroke="#c2410c"/>')
        parts.append(f'<line x1="{LEFT}" y1="{y}" x2="{LEFT + (bins + 1) * WIDE}" y2="{y}" stroke="#555"/>')
        for second in range(round(MOST_S) + 1):
            parts.append(f'<text x="{LEFT + second / BIN_S * WIDE:.0f}" y="{y + 13}">{second} s</text>')
        y += 22
    body = "\n".join(parts)
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{LEFT + (bins + 2) * WIDE + 20}" height="{y + 6}"'
        f' font-family="sans-serif" font-size="12">\n<rect width="100%" height="100%" fill="white"/>\n{body}\n</svg>\n'
    )
