"""Bidding: what an agent holds in its hand while it bids for one task."""

from __future__ import annotations

from collections.abc import Callable

from middleware.consensus.bidding.auction import Auction
from middleware.consensus.bidding.party import OnSummary
from middleware.consensus.strategy import Report

Publish = Callable[[Auction, Report | None], None]


class Bidding:
    """One agent's place in ``auction``; ``on_summary`` is told of the reports that the council announces."""

    def __init__(
        self,
        auction: Auction,
        on_summary: OnSummary,
        publish: Publish,
        expect: Callable[[Auction, float], None],
        leave: Callable[[Bidding], None],
    ) -> None:
        self.auction = auction
        self.on_summary = on_summary
        self._publish = publish
        self._expect = expect
        self._leave = leave
        self._last: Report | None = None
        self._has_bid = False

    @property
    def is_standing(self) -> bool:
        """Whether there is a bid that was not taken back."""
        return self._last is not None

    def report(self, report: Report) -> None:
        """Bid, or bid anew; an equal bid is not sent again.  Raises ``ValueError`` for a cost that is none."""
        if not self._has_bid or report != self._last:
            self._next(report)

    def withdraw(self) -> None:
        """Take the bid back; before the first one: abstain, so that nobody waits for this agent."""
        if not self._has_bid or self._last is not None:
            self._next(None)

    def expect(self, bidders: float) -> None:
        """Where this node is of the council: close the bidding as soon as that many have bid or abstained.

        Infinity: when the waiting period is over.
        """
        self._expect(self.auction, bidders)

    def leave(self) -> None:
        """Hear no more of it; the node goes on carrying the bids of others."""
        self._leave(self)

    def _next(self, report: Report | None) -> None:
        self._publish(self.auction, report)
        self._has_bid, self._last = True, report
