"""Template with every method of a strategy; this strategy selects the farthest robot.

Run its tests in this folder with ``python -m twisted.trial test_strategies``; README.md explains its installation.
"""

from __future__ import annotations

from collections.abc import Sequence

from middleware.consensus.strategy import Consensus, Report, digest_of, refusal, standing


class Farthest:
    """Select the highest cost, and among equal costs the lowest agent id; pure: no clock, no randomness, no network."""

    name = "farthest"
    version = "1"

    def find(self, contacts: Sequence[Report]) -> Consensus:
        """Return the agent that should act, given the reports of all agents; their order has no effect."""
        order = sorted(standing(contacts, self.rank), key=lambda r: (self.rank(r), r.agent))
        if not order:
            return Consensus(None, reason="no report counts")
        names = list(dict.fromkeys(r.agent for r in order))
        return Consensus(names[0], tuple(names[1:]), digest_of(order), reason=f"{order[0].cost:g} is the most")

    def improves(self, current: Report, offer: Report, hysteresis: float) -> bool:
        """Return whether a late report is so much better that the task should change hands."""
        return not refusal(offer) and offer.cost * (1.0 - hysteresis) > current.cost

    def merge(self, a: Sequence[Report], b: Sequence[Report]) -> tuple[Report, ...]:
        """Return reports with which ``find`` gives the same result as with all reports of ``a`` and ``b``."""
        return standing((*a, *b), self.rank)

    def rank(self, report: Report) -> float:
        """Return the rank of a report; the agent with the lowest rank is selected."""
        return -report.cost
