"""The best bids of one auction that one node knows; pure.

Adding bids is a join: their order and repetition make no difference.  Only the bid with the highest revision of each
agent is used.  The auction's rule selects the *standing* bids, which can affect the decision, and only these are
forwarded.  A bid that replaced an earlier bid of its agent is kept and forwarded even if it is not standing; otherwise
a delayed copy of the earlier bid would be selected again.
"""

from __future__ import annotations

from collections.abc import Iterable

from middleware.consensus.bidding.bid import Bid
from middleware.consensus.bidding.merge_rule import MergeRule
from middleware.consensus.strategy import Report

MAX_SUPERSEDING = 256


class Summary:
    """The standing bids by ``rule``, and the bids that replaced earlier bids."""

    def __init__(self, rule: MergeRule) -> None:
        self._rule = rule
        self._bids: dict[str, Bid] = {}
        self._standing: tuple[Report, ...] = ()

    @property
    def standing(self) -> tuple[Report, ...]:
        """The reports of the standing bids."""
        return self._standing

    def list_bids(self) -> tuple[Bid, ...]:
        """Return the bids to forward, sorted by the agents' ids."""
        return tuple(self._bids[agent] for agent in sorted(self._bids))

    def get(self, agent: str) -> Bid | None:
        """Return the bid of an agent, or None if it is not kept."""
        return self._bids.get(agent)

    def join(self, bids: Iterable[Bid]) -> bool:
        """Add ``bids``; return whether the summary has changed."""
        before = dict(self._bids)
        newer: dict[str, Bid] = {}
        for bid in bids:
            known = newer.get(bid.agent) or self._bids.get(bid.agent)
            if known is None or bid.rank > known.rank:
                newer[bid.agent] = bid
        if not newer:
            return False
        replaced = any(report.agent in newer for report in self._standing)
        self._bids.update(newer)
        if replaced:
            known_reports = [bid.report for bid in self._bids.values() if bid.report is not None]
            self._standing = self._rule.merge(known_reports, ())
        else:
            new_reports = [bid.report for bid in newer.values() if bid.report is not None]
            self._standing = self._rule.merge(self._standing, new_reports)
        self._remove_unneeded()
        return self._bids != before

    def _remove_unneeded(self) -> None:
        """Remove bids that are not standing and replaced no bid; limit the number of bids that replaced one."""
        standing = {report.agent for report in self._standing}
        needed = {agent: bid for agent, bid in self._bids.items() if agent in standing or bid.revision}
        not_standing = [agent for agent in needed if agent not in standing]
        for agent in not_standing[: max(0, len(not_standing) - MAX_SUPERSEDING)]:
            del needed[agent]
        self._bids = needed
