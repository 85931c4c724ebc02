"""Send an agent's bid directly to the quorum members, and check that the announcement takes it into account; pure.

If a forwarding node of a tree fails, all bids of its subtree are lost.  So a bidder that receives no announcement
requests it from a quorum member.  A bidder whose bid should have changed the announcement sends the bid to a quorum
member, within half the waiting period.
"""

from __future__ import annotations

import math
import random

from middleware.consensus.bidding.announcement import Announcement
from middleware.consensus.bidding.auction import Auction
from middleware.consensus.bidding.bid import Bid
from middleware.consensus.bidding.merge_rule import MergeRule
from middleware.consensus.bidding.outgoing_message import Offer
from middleware.entangled.contact import Contact

ANNOUNCEMENT_DELAY_S = 0.6
"""Within this number of seconds after the waiting period, an announcement reaches all of 10,000 nodes, even with packet
loss."""
REQUEST_SPREAD_SHARE = 0.25
"""Share of the waiting period within which each node sends its request at a random time."""
MIN_PAUSE_S, MAX_PAUSE_S = 0.5, 10.0
"""Minimum and maximum seconds between two requests of one bidder; the maximum applies when no member answers."""
MAX_RELAY_REQUESTS = 3
"""Maximum number of requests of a node that only forwards bids."""


class BidCheck:
    """Checks that an announcement arrives and takes the node's own bid, if there is one, into account."""

    def __init__(self, auction: Auction, own_id: bytes, rule: MergeRule, rng: random.Random) -> None:
        self.own_bid: Bid | None = None
        self.failures = 0
        self._auction = auction
        self._members = [member for member in auction.council if member.node_id != own_id]
        self._rule = rule
        self._rng = rng
        self._request_at = math.inf
        self._is_in_flight = False
        self._is_strict = False
        self._relay_requests = 0

    @property
    def due(self) -> float:
        """The time of the next request."""
        return math.inf if self._is_in_flight or not self._members else self._request_at

    @property
    def is_isolated(self) -> bool:
        """Whether all quorum members have failed to answer, one after another."""
        return self.failures >= len(self._members) > 0

    def check_bid(self, bid: Bid, announcement: Announcement | None, is_strict: bool, now: float) -> None:
        """Check ``bid`` from now on; if ``is_strict``, also when the bid changes only the standbys."""
        self.own_bid, self._is_strict = bid, is_strict
        if announcement is None:
            if self._request_at == math.inf:
                self.expect_announcement(now, ANNOUNCEMENT_DELAY_S)
        elif not self.is_counted(announcement):
            self._schedule_request(now + self._auction.waiting_period * REQUEST_SPREAD_SHARE)

    def expect_announcement(self, since: float, silence: float) -> None:
        """Expect an announcement ``silence`` seconds after the waiting period that started at ``since``."""
        waiting = self._auction.waiting_period
        self._schedule_request(since + waiting + silence)

    def on_announcement(self, announcement: Announcement, now: float) -> None:
        """Compare an announcement with the node's own bid."""
        self._request_at = math.inf
        if not self.is_counted(announcement):
            self._schedule_request(now)

    def is_counted(self, announcement: Announcement) -> bool:
        """Return whether there is no own bid, or the bid is in the announcement or would not change the decision."""
        if self.own_bid is None:
            return True
        entry = next((e for e in announcement.entries if e.report.agent == self.own_bid.agent), None)
        if entry is not None:
            return entry.revision >= self.own_bid.revision
        if self.own_bid.report is None:
            return True
        combined = self._rule.merge(announcement.reports, (self.own_bid.report,))
        if self._is_strict and self.own_bid.report in combined:
            return False
        return self._rule.decide(combined) == self._rule.decide(announcement.reports)

    def take_due_offers(self, announcement: Announcement | None, age: float, now: float) -> list[Offer]:
        """Return the request to a quorum member if it is due."""
        if now < self.due:
            return []
        self._request_at = math.inf
        if announcement is not None and self.is_counted(announcement):
            return []
        if self.own_bid is None:
            self._relay_requests += 1
            if self._relay_requests > MAX_RELAY_REQUESTS:
                return []
        self._is_in_flight = True
        member = self._members[self.failures % len(self._members)]
        return [Offer(member, (self.own_bid,) if self.own_bid is not None else (), age, is_inquiry=True)]

    def on_answer(self, announcement: Announcement | None, now: float) -> None:
        """Record that a quorum member has the bid; ``announcement`` is the newest one that this node knows."""
        self._is_in_flight = False
        self.failures = 0
        if announcement is None or not self.is_counted(announcement):
            self._request_at = min(self._request_at, now + max(MIN_PAUSE_S, self._auction.waiting_period))

    def on_failure(self, to: Contact, now: float) -> None:
        """Record that a quorum member did not answer; the next request goes to the next member."""
        self._is_in_flight = False
        self.failures += 1
        self._request_at = min(
            self._request_at, now + (min(MAX_PAUSE_S, MIN_PAUSE_S * self.failures) if self.is_isolated else 0.0)
        )

    def _schedule_request(self, moment: float) -> None:
        self._request_at = min(
            self._request_at, moment + self._rng.uniform(0.0, self._auction.waiting_period * REQUEST_SPREAD_SHARE)
        )


MAX_TRIES = 3
"""Maximum number of messages with one bid to one member; after that, the announcement shows whether the bid was
received."""
RETRY_PAUSE_S = 0.5


class DirectSender:
    """Sends a bid to each quorum member, with retries."""

    def __init__(self, auction: Auction, own_id: bytes) -> None:
        self._members = [member for member in auction.council if member.node_id != own_id]
        self._bid: Bid | None = None
        self._pending: dict[bytes, tuple[int, float]] = {}
        self._in_flight: dict[bytes, Bid] = {}
        self._silent: set[bytes] = set()

    @property
    def is_isolated(self) -> bool:
        """Whether all quorum members have failed to answer."""
        return 0 < len(self._members) <= len(self._silent)

    @property
    def due(self) -> float:
        """The time of the next message."""
        return min(
            (at for node_id, (_, at) in self._pending.items() if node_id not in self._in_flight), default=math.inf
        )

    def send_bid(self, bid: Bid, now: float) -> None:
        """Send ``bid`` to every member, instead of any earlier bid."""
        self._bid = bid
        self._pending = {member.node_id: (0, now) for member in self._members}

    def take_due_offers(self, age: float, now: float) -> list[Offer]:
        """Return the messages that are due now."""
        out: list[Offer] = []
        for member in self._members:
            _, at = self._pending.get(member.node_id, (0, math.inf))
            if self._bid is not None and at <= now and member.node_id not in self._in_flight:
                self._in_flight[member.node_id] = self._bid
                out.append(Offer(member, (self._bid,), age, is_shared=True))
        return out

    def on_answer(self, offer: Offer) -> None:
        """Record that a member confirmed the bid."""
        self._silent.discard(offer.to.node_id)
        if self._in_flight.pop(offer.to.node_id, None) is self._bid:
            self._pending.pop(offer.to.node_id, None)

    def on_failure(self, offer: Offer, now: float) -> None:
        """Record that a member did not answer."""
        self._silent.add(offer.to.node_id)
        sent_bid = self._in_flight.pop(offer.to.node_id, None)
        tries, _ = self._pending.pop(offer.to.node_id, (0, now))
        if sent_bid is not self._bid:
            self._pending[offer.to.node_id] = (0, now)
        elif tries + 1 < MAX_TRIES:
            self._pending[offer.to.node_id] = (tries + 1, now + RETRY_PAUSE_S)
