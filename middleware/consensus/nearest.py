"""Nearest: the agent with the shortest distance acts (the thesis' demonstration, section 5)."""

from __future__ import annotations

import math
from collections.abc import Sequence

from middleware.consensus.strategy import Consensus, Report, digest_of


class Nearest:
    """The lowest cost wins; equal costs are decided by the agent's id, so that there is never none and never two."""

    name = "nearest"

    def find(self, contacts: Sequence[Report]) -> Consensus:
        """The consensus point; None is assigned where nobody reports a finite, non-negative cost."""
        best: dict[str, Report] = {}
        for report in contacts:
            if _is_lawful(report):
                known = best.get(report.agent)
                if known is None or report.cost < known.cost:
                    best[report.agent] = report
        order = [r.agent for r in sorted(best.values(), key=lambda r: (r.cost, r.agent))]
        if not order:
            return Consensus(None)
        return Consensus(order[0], tuple(order[1:]), digest_of(list(best.values())))

    def improves(self, current: Report, offer: Report, hysteresis: float) -> bool:
        """Whether ``offer`` is nearer by more than the share ``hysteresis``; what is no distance never is."""
        return _is_lawful(offer) and offer.cost < current.cost * (1.0 - hysteresis)


def _is_lawful(report: Report) -> bool:
    return math.isfinite(report.cost) and report.cost >= 0
