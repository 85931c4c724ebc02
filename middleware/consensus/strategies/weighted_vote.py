"""Strategy ``weighted_vote``: the option with more than half of the total weight wins."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence

from middleware.consensus.strategies.nearest import Nearest
from middleware.consensus.strategy import Consensus, Report, build_consensus, standing


class WeightedVote(Nearest):
    """A vote in which the newest vote of each agent has the agent's weight.

    An agent with a report without a choice has not voted yet. An option with more than half of the weight of all agents
    that may vote wins immediately. If all reports contain the same ``electorate``, no node can find a different
    majority, whatever subset of the reports it has. If all agents have voted without such a majority, the heaviest
    option wins; ties are broken by the lowest hash. The agent with the lowest cost among the voters of the winning
    option acts.
    """

    name = "weighted_vote"
    version = "1"
    reads = ("choice", "weight", "electorate")

    def find(self, contacts: Sequence[Report]) -> Consensus:
        """Return the decision; its ``choice`` is "" if the vote is undecided."""
        counted = self.merge(contacts, ())
        if not counted:
            return Consensus(None, strategy=self.name, reason="no report is valid")
        present = math.fsum(r.weight for r in counted)
        all_weight = max(present, max(r.electorate for r in counted))
        weights: dict[str, float] = {}
        for choice in sorted({r.choice for r in counted} - {""}):
            weights[choice] = math.fsum(r.weight for r in counted if r.choice == choice)
        cast = math.fsum(r.weight for r in counted if r.choice)
        best = min(weights, key=lambda option: (-weights[option], _hash(option)), default="")
        tally = ", ".join(f"{option}: {weight:g}" for option, weight in weights.items())
        is_decided = best != "" and (2.0 * weights[best] > all_weight or cast >= all_weight > 0.0)
        if not is_decided:
            why = f"{tally or 'no vote'}; more than half of {all_weight:g} is needed"
            return build_consensus(self.name, (), counted, why)
        side = sorted((r for r in counted if r.choice == best), key=lambda r: (r.cost, r.agent))
        return build_consensus(self.name, side, counted, f"{best} of {tally}", choice=best)

    def merge(self, a: Sequence[Report], b: Sequence[Report]) -> tuple[Report, ...]:
        """Return the report with the newest vote of each agent, for the task with the lowest id."""
        counted = standing((*a, *b), lambda report: -report.sequence)
        return tuple(r for r in counted if r.task == counted[0].task)


def _hash(option: str) -> bytes:
    return hashlib.blake2s(option.encode(errors="replace"), digest_size=8).digest()
