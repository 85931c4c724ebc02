"""Rule: how the reports of one auction are joined and read, whatever its strategy does; pure.

The strategy is somebody else's code.  Where it raises, gives back what is no report, or has no ``merge`` of its own,
the ``LEADING`` cheapest reports stand; it may choose among reports, but what it makes up is dropped.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

from middleware.consensus.strategy import Report

LEADING = 4
"""Reports in a summary where the strategy does not say: the winner and who stands by.  Signed, they fill a datagram."""
MAX_REPORTS = 1024

Blame = Callable[[str, Exception], None]
"""Told that a strategy raised: the name of its method, and what it raised."""


class Rule:
    """``strategy`` (a ``ConsensusAlgorithm``, with or without ``merge``) behind a guard."""

    def __init__(self, strategy: Any, blame: Blame = lambda method, error: None) -> None:
        self._find = strategy.find
        self._merge: Callable[[Sequence[Report], Sequence[Report]], Iterable[Report]]
        self._merge = getattr(strategy, "merge", leading)
        self._blame = blame

    def merged(self, a: Sequence[Report], b: Sequence[Report]) -> tuple[Report, ...]:
        """The join of two summaries: reports out of either, each agent once, in an order of its own."""
        given = {*a, *b}
        try:
            chosen = list(dict.fromkeys(report for report in self._merge(tuple(a), tuple(b)) if report in given))
        except Exception as error:  # somebody else's code
            self._blame("merge", error)
            return leading(a, b)
        if len(chosen) > MAX_REPORTS or len({report.agent for report in chosen}) < len(chosen):
            return leading(chosen, (), MAX_REPORTS)
        return tuple(sorted(chosen, key=_order))

    def decided(self, reports: Sequence[Report]) -> tuple[str | None, str]:
        """What is decided by these reports, all but who stands by: equal where nothing depends on the difference."""
        try:
            consensus = self._find(tuple(reports))
            agent = consensus.assigned_agent
            others = repr([getattr(consensus, name, None) for name in ("assigned", "value", "choice")])
        except Exception as error:  # somebody else's code
            self._blame("find", error)
        else:
            if agent is None or any(report.agent == agent for report in reports):
                return agent, others
        return (min(reports, key=_order).agent if reports else None), ""


def leading(a: Sequence[Report], b: Sequence[Report], room: int = LEADING) -> tuple[Report, ...]:
    """The ``room`` cheapest reports of both, each agent once; equal costs are decided by the agent's id."""
    once: dict[str, Report] = {}
    for report in (*a, *b):
        known = once.get(report.agent)
        # Two different reports of one agent are rare; then what they say decides, and not which came first.
        if known is None or (report != known and (report.cost, repr(report)) < (known.cost, repr(known))):
            once[report.agent] = report
    return tuple(sorted(once.values(), key=_order)[:room])


def _order(report: Report) -> tuple[float, str]:
    return report.cost, report.agent
