"""Merge and evaluate the reports of one auction with its strategy, with protection against faulty strategies; pure.

If a third-party strategy raises an exception, returns invalid reports, or has no ``merge``, the ``MAX_LEADING_REPORTS``
cheapest reports are used.  Reports in the result that were not in the arguments are dropped.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

from middleware.consensus.strategy import Report

MAX_LEADING_REPORTS = 4
"""Default number of reports in a summary: the winner and its standbys, whose signed bids fill one datagram."""
MAX_REPORTS = 1024

OnFault = Callable[[str, Exception], None]
"""Called with the name of the method that raised an exception, and the exception."""


class MergeRule:
    """A guarded ``strategy`` (a ``ConsensusAlgorithm``, with or without ``merge``)."""

    def __init__(self, strategy: Any, on_fault: OnFault = lambda method, error: None) -> None:
        self._find = strategy.find
        self._merge: Callable[[Sequence[Report], Sequence[Report]], Iterable[Report]]
        self._merge = getattr(strategy, "merge", select_leading)
        self._on_fault = on_fault

    def merge(self, a: Sequence[Report], b: Sequence[Report]) -> tuple[Report, ...]:
        """Return the join of two summaries: a sorted subset of their reports with one report per agent."""
        known_reports = {*a, *b}
        try:
            chosen = list(
                dict.fromkeys(report for report in self._merge(tuple(a), tuple(b)) if report in known_reports)
            )
        except Exception as error:  # third-party code may raise anything
            self._on_fault("merge", error)
            return select_leading(a, b)
        if len(chosen) > MAX_REPORTS or len({report.agent for report in chosen}) < len(chosen):
            return select_leading(chosen, (), MAX_REPORTS)
        return tuple(sorted(chosen, key=_sort_key))

    def decide(self, reports: Sequence[Report]) -> tuple[str | None, str]:
        """Return the decision, without standbys, as values that can be compared."""
        try:
            consensus = self._find(tuple(reports))
            agent = consensus.assigned_agent
            others = repr([getattr(consensus, name, None) for name in ("assigned", "value", "choice")])
        except Exception as error:  # third-party code may raise anything
            self._on_fault("find", error)
        else:
            if agent is None or any(report.agent == agent for report in reports):
                return agent, others
        return (min(reports, key=_sort_key).agent if reports else None), ""


def select_leading(a: Sequence[Report], b: Sequence[Report], limit: int = MAX_LEADING_REPORTS) -> tuple[Report, ...]:
    """Return the ``limit`` cheapest reports in ``a`` and ``b``, one per agent; ties are broken by the agent's id."""
    once: dict[str, Report] = {}
    for report in (*a, *b):
        known = once.get(report.agent)
        # In the rare case of two different reports of one agent, their content decides, not their order of arrival.
        if known is None or (report != known and (report.cost, repr(report)) < (known.cost, repr(known))):
            once[report.agent] = report
    return tuple(sorted(once.values(), key=_sort_key)[:limit])


def _sort_key(report: Report) -> tuple[float, str]:
    return report.cost, report.agent
