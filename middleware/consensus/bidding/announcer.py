"""Announce the best bids of an auction: collect bids at a quorum member and share them with the other members.  Pure.

The first member makes the announcement; if it is silent, the next member does.  Two announcements at the same time are
harmless (``announcement``).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable

from middleware.consensus.bidding.announcement import AnnouncedReport, Announcement
from middleware.consensus.bidding.auction import Auction
from middleware.consensus.bidding.bid import Bid
from middleware.consensus.bidding.merge_rule import MergeRule
from middleware.consensus.bidding.outgoing_message import MAX_BIDS_PER_MESSAGE, Offer
from middleware.consensus.bidding.summary import Summary
from middleware.consensus.strategy import Report

REPLACEMENT_DELAY_S = 0.4
"""Seconds after which the next member replaces a silent one: the timeout of one message."""
LATE_BIDS_S = 0.05
"""Seconds for which bids that arrive after the announcement are collected."""
GATHER_S = 0.1
"""Seconds for which bids are collected before they are sent to other members."""
INFORMED_MEMBERS = 2
"""Number of quorum members to which this member sends all bids: the first ones that answer.  One of them makes the
announcement if the first member fails."""
RETRY_PAUSE_S, MAX_RETRY_PAUSE_S = 1.0, 30.0
"""Seconds after which a silent member is tried again: first and maximum value, doubled each time."""
MAX_COUNTED_BIDDERS = 4096


class Announcer:
    """The quorum member with the given ``rank`` in ``auction``; ``sign`` returns its signature."""

    def __init__(self, auction: Auction, rank: int, rule: MergeRule, sign: Callable[[bytes], bytes]) -> None:
        self.summary = Summary(rule)
        self.expected_bidders = math.inf
        self._auction = auction
        self._rank = rank
        self._rule = rule
        self._sign = sign
        self._number = 0
        self._closes_at = math.inf
        self._announce_at = math.inf
        self._bidders: set[str] = set()
        self._other_members = [member for member in auction.council if member.node_id != auction.council[rank].node_id]
        self._known: dict[bytes, dict[str, tuple[int, bytes]]] = {member.node_id: {} for member in self._other_members}
        self._in_flight: set[bytes] = set()
        self._silent: dict[bytes, int] = {}
        self._send_at = dict.fromkeys(self._known, math.inf)

    @property
    def due(self) -> float:
        """The time of the next message or announcement."""
        idle = [at for node_id, at in self._send_at.items() if node_id not in self._in_flight]
        return min([self._announce_at, *idle])

    def join(self, bids: Iterable[Bid], sender: bytes, is_shared: bool, age: float, now: float) -> None:
        """Add bids from ``sender``."""
        bids = tuple(bids)
        if len(self._bidders) < MAX_COUNTED_BIDDERS:
            self._bidders.update(bid.agent for bid in bids)
        changed = self.summary.join(bids)
        for member_id in self._known:
            if is_shared or member_id == sender:
                self._record_known(member_id, bids)
        self._schedule_sharing(now + GATHER_S)
        if self._closes_at == math.inf and bids:
            self._closes_at = now + max(0.0, self._auction.waiting_period - age)
            self._announce_at = self._closes_at + self._rank * REPLACEMENT_DELAY_S
        elif changed:
            self._announce_at = min(
                self._announce_at, max(now + LATE_BIDS_S, self._closes_at) + self._rank * REPLACEMENT_DELAY_S
            )
        if len(self._bidders) >= self.expected_bidders and now < self._closes_at:
            self._closes_at = now
            self._announce_at = now + self._rank * REPLACEMENT_DELAY_S

    def on_announcement(self, announcement: Announcement) -> None:
        """Record the number of another member's announcement."""
        self._number = max(self._number, announcement.number)

    def make_due_announcement(self, last: Announcement | None, is_strict: bool, now: float) -> Announcement | None:
        """Return the announcement that is due after ``last``; ``is_strict``: also if only the standbys changed."""
        if now < self._announce_at:
            return None
        self._announce_at = math.inf
        entries = self._make_entries()
        if last is not None and not self._changes_decision(last, entries, is_strict):
            return None
        if not entries and last is None:
            return None
        self._number += 1
        return Announcement(self._number, self._rank, entries).sign(self._sign, self._auction)

    def take_due_offers(self, age: float, now: float) -> list[Offer]:
        """Return the messages to other members that are due now."""
        out = []
        for member_id in self._other_members:
            if now < self._send_at[member_id.node_id] or member_id.node_id in self._in_flight:
                continue
            self._send_at[member_id.node_id] = math.inf
            missing = self._find_missing_bids(member_id.node_id)
            if missing:
                self._in_flight.add(member_id.node_id)
                out.append(Offer(member_id, missing, age))
        return out

    def on_answer(self, offer: Offer, now: float) -> None:
        """Record that a member confirmed the bids."""
        self._in_flight.discard(offer.to.node_id)
        self._record_known(offer.to.node_id, offer.bids)
        self._silent.pop(offer.to.node_id, None)
        self._schedule_sharing(now + GATHER_S)

    def on_failure(self, offer: Offer, now: float) -> None:
        """Record that a member did not answer."""
        self._in_flight.discard(offer.to.node_id)
        tries = self._silent.get(offer.to.node_id, 0)
        self._silent[offer.to.node_id] = tries + 1
        pause = min(MAX_RETRY_PAUSE_S, RETRY_PAUSE_S * 2.0 ** min(tries, 8))
        self._send_at[offer.to.node_id] = min(self._send_at[offer.to.node_id], now + pause)
        self._schedule_sharing(now)

    def _schedule_sharing(self, moment: float) -> None:
        """Schedule messages with missing bids to the first members that answer, at ``moment`` or earlier."""
        for member_id in [node_id for node_id in self._known if node_id not in self._silent][:INFORMED_MEMBERS]:
            if self._find_missing_bids(member_id):
                self._send_at[member_id] = min(self._send_at[member_id], moment)

    def _record_known(self, member_id: bytes, bids: Iterable[Bid]) -> None:
        """Record that a member has ``bids``; bids that need not be forwarded are not recorded."""
        known = {**self._known[member_id], **{bid.agent: bid.rank for bid in bids}}
        self._known[member_id] = {b.agent: known[b.agent] for b in self.summary.list_bids() if b.agent in known}

    def _find_missing_bids(self, member_id: bytes) -> tuple[Bid, ...]:
        """Return bids that a member does not have, at most as many as fit into one message."""
        known = self._known[member_id]
        return tuple(bid for bid in self.summary.list_bids() if known.get(bid.agent) != bid.rank)[:MAX_BIDS_PER_MESSAGE]

    def _make_entries(self) -> tuple[AnnouncedReport, ...]:
        bids = {bid.agent: bid for bid in self.summary.list_bids()}
        return tuple(AnnouncedReport(report, bids[report.agent].revision) for report in self.summary.standing)

    def _changes_decision(self, last: Announcement, entries: tuple[AnnouncedReport, ...], is_strict: bool) -> bool:
        """Return whether the bids known here would change the decision of nodes that know ``last``."""
        announced = last.reports
        combined = self._rule.merge(_drop_replaced(last.entries, self.summary), tuple(e.report for e in entries))
        if is_strict and set(combined) != set(announced):
            return True
        return self._rule.decide(combined) != self._rule.decide(announced)


def _drop_replaced(entries: tuple[AnnouncedReport, ...], summary: Summary) -> tuple[Report, ...]:
    """Return the announced reports that no known bid has replaced."""
    current = []
    for entry in entries:
        known = summary.get(entry.report.agent)
        if known is None or known.revision <= entry.revision:
            current.append(entry.report)
    return tuple(current)
