"""Template: every method that a strategy has, to be copied and changed.  This one names the farthest.

Run its tests in this folder by ``python -m twisted.trial test_strategies``; README.md says how a node finds it.
"""

from __future__ import annotations

from collections.abc import Sequence

from middleware.consensus.strategy import Consensus, Report, digest_of, refusal, standing


class Farthest:
    """The highest cost wins, ties go by the agent's id; a strategy asks no clock, no dice, no network."""

    name = "farthest"
    version = "1"

    def find(self, contacts: Sequence[Report]) -> Consensus:
        """Who should act, out of the reports of all, oneself included; equal for equal reports in any order."""
        order = sorted(standing(contacts, self.rank), key=lambda r: (self.rank(r), r.agent))
        if not order:
            return Consensus(None, reason="no report counts")
        names = list(dict.fromkeys(r.agent for r in order))
        return Consensus(names[0], tuple(names[1:]), digest_of(order), reason=f"{order[0].cost:g} is the most")

    def improves(self, current: Report, offer: Report, hysteresis: float) -> bool:
        """Whether a late report is so much better that the task should change hands."""
        return not refusal(offer) and offer.cost * (1.0 - hysteresis) > current.cost

    def merge(self, a: Sequence[Report], b: Sequence[Report]) -> tuple[Report, ...]:
        """What of both has to travel on, so that ``find`` of it finds the same as of all reports."""
        return standing((*a, *b), self.rank)

    def rank(self, report: Report) -> float:
        """The lowest rank wins."""
        return -report.cost
