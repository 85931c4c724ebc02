"""Strategy ``nearest``: the agent with the lowest cost acts (the demonstration of the thesis, section 5)."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from middleware.consensus.strategy import Consensus, Report, build_consensus, refusal, standing

SUMMARY_REPORTS = 4
"""Number of reports in a summary: one of the agents acts, the others are standbys.  Four signed reports fill a
datagram."""


class Nearest:
    """The agent with the lowest cost acts.

    Ties are broken by uuid, so exactly one agent is assigned if any report is valid.
    """

    name = "nearest"
    version = "2"
    reads: tuple[str, ...] = ()

    def find(self, contacts: Sequence[Report]) -> Consensus:
        """Return the decision; if no report is valid (``strategy.refusal``), no agent is assigned."""
        order = select_best(contacts, self.weigh)
        if not order:
            return Consensus(None, strategy=self.name, reason="no report is valid")
        return build_consensus(self.name, order, order, f"cost {order[0].cost:.2f}, the lowest of {len(order)}")

    def improves(self, current: Report, offer: Report, hysteresis: float) -> bool:
        """Return whether ``offer`` is better than ``current`` by more than the share ``hysteresis``.

        A valid offer is better than an invalid ``current``; an invalid offer is never better.
        """
        if refusal(offer):
            return False
        return bool(refusal(current)) or self.weigh(offer) < self.weigh(current) * (1.0 - hysteresis)

    def merge(self, a: Sequence[Report], b: Sequence[Report]) -> tuple[Report, ...]:
        """Return the best reports in ``a`` and ``b``."""
        return tuple(select_best((*a, *b), self.weigh))

    def weigh(self, report: Report) -> float:
        """Return the cost by which reports are compared; the lowest wins."""
        return report.cost


def select_best(contacts: Sequence[Report], rank: Callable[[Report], float]) -> list[Report]:
    """Return the best reports by ``rank``, one per agent, the best first.

    If the reports are for several tasks, only those for the task with the lowest id are used.
    """
    counted = standing(contacts, rank)
    return sorted((r for r in counted if r.task == counted[0].task), key=lambda r: (rank(r), r.agent))[:SUMMARY_REPORTS]
