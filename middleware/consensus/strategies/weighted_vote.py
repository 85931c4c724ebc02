"""Weighted vote: which of several options it is; more than half of all weight decides."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence

from middleware.consensus.strategies.nearest import Nearest
from middleware.consensus.strategy import Consensus, Report, led_by, standing


class WeightedVote(Nearest):
    """Each agent's newest vote counts by its weight; who reports without a choice may vote but has not yet.

    An option with more than half of the weight of all that may vote wins at once: no other majority can exist, whoever
    counts, as long as all reports name the same ``electorate``.  When all have voted and none has so much, the heaviest
    option wins, and of equally heavy ones that with the lowest hash.  The cheapest agent among the winning side acts.
    """

    name = "weighted_vote"
    version = "1"
    reads = ("choice", "weight", "electorate")

    def find(self, contacts: Sequence[Report]) -> Consensus:
        """The consensus point; its ``choice`` is "" where nothing is decided yet."""
        counted = self.merge(contacts, ())
        if not counted:
            return Consensus(None, strategy=self.name, reason="no report counts")
        present = math.fsum(r.weight for r in counted)
        all_weight = max(present, max(r.electorate for r in counted))
        weights: dict[str, float] = {}
        for choice in sorted({r.choice for r in counted} - {""}):
            weights[choice] = math.fsum(r.weight for r in counted if r.choice == choice)
        cast = math.fsum(r.weight for r in counted if r.choice)
        best = min(weights, key=lambda option: (-weights[option], _hash(option)), default="")
        told = ", ".join(f"{option}: {weight:g}" for option, weight in weights.items())
        is_decided = best != "" and (2.0 * weights[best] > all_weight or cast >= all_weight > 0.0)
        if not is_decided:
            why = f"{told or 'no vote'}; more than half of {all_weight:g} decides"
            return led_by(self.name, (), counted, why)
        side = sorted((r for r in counted if r.choice == best), key=lambda r: (r.cost, r.agent))
        return led_by(self.name, side, counted, f"{best} of {told}", choice=best)

    def merge(self, a: Sequence[Report], b: Sequence[Report]) -> tuple[Report, ...]:
        """Everybody's newest vote, about the first task by name."""
        counted = standing((*a, *b), lambda report: -report.sequence)
        return tuple(r for r in counted if r.task == counted[0].task)


def _hash(option: str) -> bytes:
    return hashlib.blake2s(option.encode(errors="replace"), digest_size=8).digest()
