"""Nearest: the agent with the shortest distance acts (the thesis' demonstration, section 5)."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from middleware.consensus.strategy import Consensus, Report, led_by, refusal, standing

KEPT = 4
"""How many of the best a summary keeps: one to act, the others to stand by; signed, that many fill a datagram."""


class Nearest:
    """The lowest cost wins; equal costs are decided by the agent's id, so that there is never none and never two."""

    name = "nearest"
    version = "2"
    reads: tuple[str, ...] = ()

    def find(self, contacts: Sequence[Report]) -> Consensus:
        """The consensus point; None is assigned where no report counts (``strategy.refusal`` says why)."""
        order = best_of(contacts, self.weigh)
        if not order:
            return Consensus(None, strategy=self.name, reason="no report counts")
        return led_by(self.name, order, order, f"{order[0].cost:.2f}, least of {len(order)}")

    def improves(self, current: Report, offer: Report, hysteresis: float) -> bool:
        """Whether ``offer`` weighs less than ``current`` by more than the share ``hysteresis``.

        One that counts for nothing is better than no other, and any that counts is better than it.
        """
        if refusal(offer):
            return False
        return bool(refusal(current)) or self.weigh(offer) < self.weigh(current) * (1.0 - hysteresis)

    def merge(self, a: Sequence[Report], b: Sequence[Report]) -> tuple[Report, ...]:
        """The best of both."""
        return tuple(best_of((*a, *b), self.weigh))

    def weigh(self, report: Report) -> float:
        """The lowest weight wins."""
        return report.cost


def best_of(contacts: Sequence[Report], rank: Callable[[Report], float]) -> list[Report]:
    """The lowest by ``rank``, one of each agent, the lowest first; of several tasks only the first by name counts."""
    counted = standing(contacts, rank)
    return sorted((r for r in counted if r.task == counted[0].task), key=lambda r: (rank(r), r.agent))[:KEPT]
