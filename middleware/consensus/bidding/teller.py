"""Teller: a member of the council gathers bids, shares them with its fellows, and announces what stands; pure.

The first member announces; the next one steps in where the first is silent.  That two of them may announce at once
harms nothing: see ``announcement``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable

from middleware.consensus.bidding.announcement import Announcement, Entry
from middleware.consensus.bidding.auction import Auction
from middleware.consensus.bidding.bid import Bid
from middleware.consensus.bidding.errand import MAX_BIDS, Offer
from middleware.consensus.bidding.rule import Rule
from middleware.consensus.bidding.summary import Summary
from middleware.consensus.strategy import Report

STAND_IN = 0.4
"""Seconds after which the next member announces what the one before it should have: the tries of one errand."""
LATER = 0.05
"""Seconds over which what comes after the announcement is gathered."""
GATHER = 0.1
"""Seconds over which what comes one by one is gathered for the fellows."""
INFORMED = 2
"""Fellows that are kept informed: the first of the council that answer, who announce and stand in."""
AGAIN, MOST_PAUSE = 1.0, 30.0
"""Seconds after which a fellow that did not answer is tried again, at first and at most; doubled each time."""
MAX_COUNTED = 4096


class Teller:
    """The member at place ``rank`` of the council of ``auction``; ``sign`` makes its signature."""

    def __init__(self, auction: Auction, rank: int, rule: Rule, sign: Callable[[bytes], bytes]) -> None:
        self.summary = Summary(rule)
        self.expected = math.inf
        self._auction = auction
        self._rank = rank
        self._rule = rule
        self._sign = sign
        self._number = 0
        self._closes_at = math.inf
        self._speak_at = math.inf
        self._bidders: set[str] = set()
        self._fellows = [member for member in auction.council if member.node_id != auction.council[rank].node_id]
        self._known: dict[bytes, dict[str, tuple[int, bytes]]] = {member.node_id: {} for member in self._fellows}
        self._under_way: set[bytes] = set()
        self._silent: dict[bytes, int] = {}
        self._send_at = dict.fromkeys(self._known, math.inf)

    @property
    def due(self) -> float:
        """When there is something to say."""
        idle = [at for node_id, at in self._send_at.items() if node_id not in self._under_way]
        return min([self._speak_at, *idle])

    def join(self, bids: Iterable[Bid], sender: bytes, is_shared: bool, age: float, now: float) -> None:
        """Take bids in that ``sender`` gave."""
        bids = tuple(bids)
        if len(self._bidders) < MAX_COUNTED:
            self._bidders.update(bid.agent for bid in bids)
        changed = self.summary.join(bids)
        for fellow in self._known:
            if is_shared or fellow == sender:
                self._knows(fellow, bids)
        self._inform(now + GATHER)
        if self._closes_at == math.inf and bids:
            self._closes_at = now + max(0.0, self._auction.waiting - age)
            self._speak_at = self._closes_at + self._rank * STAND_IN
        elif changed:
            self._speak_at = min(self._speak_at, max(now + LATER, self._closes_at) + self._rank * STAND_IN)
        if len(self._bidders) >= self.expected and now < self._closes_at:
            self._closes_at = now
            self._speak_at = now + self._rank * STAND_IN

    def heard(self, announcement: Announcement) -> None:
        """Take note of what a fellow announced."""
        self._number = max(self._number, announcement.number)

    def announcement(self, last: Announcement | None, is_strict: bool, now: float) -> Announcement | None:
        """What has to be announced now, after ``last``; with ``is_strict`` also where only stand-bys changed."""
        if now < self._speak_at:
            return None
        self._speak_at = math.inf
        entries = self._entries()
        if last is not None and not self._is_news(last, entries, is_strict):
            return None
        if not entries and last is None:
            return None
        self._number += 1
        return Announcement(self._number, self._rank, entries).signed(self._sign, self._auction)

    def offers(self, age: float, now: float) -> list[Offer]:
        """What fellows should know."""
        out = []
        for fellow in self._fellows:
            if now < self._send_at[fellow.node_id] or fellow.node_id in self._under_way:
                continue
            self._send_at[fellow.node_id] = math.inf
            fresh = self._fresh_for(fellow.node_id)
            if fresh:
                self._under_way.add(fellow.node_id)
                out.append(Offer(fellow, fresh, age))
        return out

    def answered(self, offer: Offer, now: float) -> None:
        """A fellow has confirmed."""
        self._under_way.discard(offer.to.node_id)
        self._knows(offer.to.node_id, offer.bids)
        self._silent.pop(offer.to.node_id, None)
        self._inform(now + GATHER)

    def failed(self, offer: Offer, now: float) -> None:
        """A fellow did not answer."""
        self._under_way.discard(offer.to.node_id)
        tries = self._silent.get(offer.to.node_id, 0)
        self._silent[offer.to.node_id] = tries + 1
        pause = min(MOST_PAUSE, AGAIN * 2.0 ** min(tries, 8))
        self._send_at[offer.to.node_id] = min(self._send_at[offer.to.node_id], now + pause)
        self._inform(now)

    def _inform(self, moment: float) -> None:
        """Let the first fellows that answer have what they do not have, from ``moment`` on."""
        for fellow in [node_id for node_id in self._known if node_id not in self._silent][:INFORMED]:
            if self._fresh_for(fellow):
                self._send_at[fellow] = min(self._send_at[fellow], moment)

    def _knows(self, fellow: bytes, bids: Iterable[Bid]) -> None:
        """Take note that a fellow has ``bids``; only what has to travel on is kept in mind."""
        known = {**self._known[fellow], **{bid.agent: bid.rank for bid in bids}}
        self._known[fellow] = {b.agent: known[b.agent] for b in self.summary.bids() if b.agent in known}

    def _fresh_for(self, fellow: bytes) -> tuple[Bid, ...]:
        """What a fellow does not have yet, as much as one message takes."""
        known = self._known[fellow]
        return tuple(bid for bid in self.summary.bids() if known.get(bid.agent) != bid.rank)[:MAX_BIDS]

    def _entries(self) -> tuple[Entry, ...]:
        bids = {bid.agent: bid for bid in self.summary.bids()}
        return tuple(Entry(report, bids[report.agent].revision) for report in self.summary.standing)

    def _is_news(self, last: Announcement, entries: tuple[Entry, ...], is_strict: bool) -> bool:
        """Whether those who know ``last`` would decide otherwise if they knew what is known here."""
        announced = last.reports
        combined = self._rule.merged(_current(last.entries, self.summary), tuple(e.report for e in entries))
        if is_strict and set(combined) != set(announced):
            return True
        return self._rule.decided(combined) != self._rule.decided(announced)


def _current(entries: tuple[Entry, ...], summary: Summary) -> tuple[Report, ...]:
    """The reports that were announced and that, as far as is known here, nothing took the place of."""
    current = []
    for entry in entries:
        known = summary.of(entry.report.agent)
        if known is None or known.revision <= entry.revision:
            current.append(entry.report)
    return tuple(current)
