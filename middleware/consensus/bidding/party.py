"""One node's part in one auction: it bids, forwards bids, or announces the result; pure.

``errands`` returns the outgoing messages, and ``due`` the time of the next call.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Iterable

from middleware.consensus.bidding.announcement import Announcement
from middleware.consensus.bidding.auction import Auction
from middleware.consensus.bidding.audience import Audience
from middleware.consensus.bidding.bid import Bid
from middleware.consensus.bidding.check import Check, Direct
from middleware.consensus.bidding.errand import Errand, Notice, Offer
from middleware.consensus.bidding.flood import Flood
from middleware.consensus.bidding.rule import Rule
from middleware.consensus.bidding.scale import DIRECT
from middleware.consensus.bidding.summary import Summary
from middleware.consensus.bidding.teller import Teller
from middleware.consensus.bidding.tree import MAX_CHILDREN, Branch
from middleware.consensus.strategy import Report
from middleware.entangled.contact import Contact

RELAY_SILENCE = 0.4
"""Seconds of silence after which a forwarding node asks on behalf of all behind it, before they ask themselves."""

MOST_REVISION = 2**32
"""Higher announced revisions are considered forged, and the node does not try to exceed them."""

OnSummary = Callable[[tuple[Report, ...]], None]
"""Called with the reports that stand, after each change."""


class Party:
    """The part of the node ``me`` in ``auction``; ``sign`` signs for it, ``contacts`` returns its contacts."""

    def __init__(
        self,
        auction: Auction,
        me: Contact,
        rule: Rule,
        contacts: Callable[[], Iterable[Contact]],
        rng: random.Random,
        sign: Callable[[bytes], bytes],
        on_summary: OnSummary,
    ) -> None:
        self.auction = auction
        self.announcement: Announcement | None = None
        self.audience = Audience()
        self._on_summary = on_summary
        self._me = me
        self._rule = rule
        self._rank = auction.rank(me.node_id)
        self._teller = Teller(auction, self._rank, rule, sign) if self._rank is not None else None
        self._branch = Branch(auction, me.node_id, rule, contacts)
        self._gatherer: Teller | Branch = self._teller or self._branch
        self._check = Check(auction, me.node_id, rule, rng)
        self._direct = Direct(auction, me.node_id)
        self._flood = Flood(me.node_id, rule, contacts, rng)
        self._flooded_at = math.inf
        self.told: tuple[Report, ...] = ()
        self.next_revision = 0
        self._first_at = math.inf
        self._is_relay = False
        if self._teller is not None:
            for member in auction.council:
                if member.node_id != me.node_id:
                    self.audience.add(member, is_shared=True)

    @property
    def summary(self) -> Summary:
        """The bids that this node has collected."""
        return self._gatherer.summary

    @property
    def due(self) -> float:
        """The time of the next message."""
        told_at = self.audience.due(self.announcement, self._is_mine)
        checked_at = self._check.due if self._teller is None else math.inf
        return min(self._direct.due, self._flooded_at, told_at, self._gatherer.due, checked_at)

    @property
    def own(self) -> Bid | None:
        """The last bid of this node's own agent."""
        return self._check.own

    @property
    def is_outlived(self) -> bool:
        """Whether an announced bid from this agent's earlier run replaced its own, so that it has to bid again."""
        return self.own is not None and self.own.revision < self.next_revision - 1

    def expect(self, bidders: float) -> None:
        """Close the bidding as soon as that many agents have bid or abstained."""
        if self._teller is not None:
            self._teller.expected = bidders

    def bid(self, bid: Bid, path: str, now: float) -> None:
        """Make or withdraw the own bid."""
        self._first_at = min(self._first_at, now)
        self.next_revision = max(self.next_revision, bid.revision + 1)
        is_direct = path == DIRECT
        if is_direct:
            self._direct.bid(bid, now)
        if self._teller is not None:
            self._teller.join([bid], self._me.node_id, is_direct, now - self._first_at, now)
        elif not is_direct:
            self._branch.join([bid], now)
        self._check.bid(bid, self.announcement, is_direct, now)
        if self._flooded_at != math.inf or self._flood.summary.standing:
            self._flood_own_bid(now)

    def has_room(self, sender: Contact) -> bool:
        """Return whether this node takes the bids of ``sender``.

        Quorum members take all, other nodes a limited number.
        """
        return self._teller is not None or len(self.audience) < MAX_CHILDREN or self.audience.has(sender)

    def offered(
        self, bids: Iterable[Bid], sender: Contact, age: float, is_shared: bool, now: float
    ) -> Announcement | None:
        """Process the bids of ``sender``; returns the announcement, if there is one."""
        self._first_at = min(self._first_at, now - age)
        self.audience.add(sender, is_shared and self._teller is not None)
        if self._teller is not None:
            self._teller.join(bids, sender.node_id, is_shared, age, now)
        else:
            self._branch.join(bids, now)
            if not self._is_relay and self.announcement is None:
                self._is_relay = True
                self._check.expect(self._first_at, RELAY_SILENCE)
        if self.announcement is not None:
            self.audience.knows(sender, self.announcement)
        return self.announcement

    def announced(self, announcement: Announcement, now: float) -> None:
        """Process a checked announcement; older ones are ignored."""
        if self.announcement is not None and announcement.precedence <= self.announcement.precedence:
            return
        self.announcement = announcement
        if self._teller is not None:
            self._teller.heard(announcement)
        self._check.heard(announcement, now)
        for entry in announcement.entries:
            if entry.report.agent == self._me.node_id.hex() and entry.revision < MOST_REVISION:
                own = self.own
                is_mine = own is not None and (own.revision, own.report) == (entry.revision, entry.report)
                self.next_revision = max(self.next_revision, entry.revision + (1 if is_mine else 2))
        self._notify()

    def cried(self, bids: Iterable[Bid], sender: Contact, now: float) -> None:
        """Process flooded bids; an exclusive task is not decided by them."""
        if self.auction.exclusive:
            return
        self._first_at = min(self._first_at, now)
        if self._flood.join(bids, sender):
            if self._check.own is not None:
                self._flood.join([self._check.own])
            self._flooded_at = min(self._flooded_at, max(now, self._first_at + self.auction.waiting))

    def errands(self, now: float) -> list[Errand]:
        """Return the messages that are due now."""
        age = max(0.0, now - self._first_at) if self._first_at != math.inf else 0.0
        out: list[Errand] = []
        if self._teller is not None:
            new_announcement = self._teller.announcement(self.announcement, self.audience.is_shared, now)
            if new_announcement is not None:
                self.announced(new_announcement, now)
        out += self._gatherer.offers(age, now)
        if self._teller is None:
            out += self._check.offers(self.announcement, age, now)
        out += self._direct.offers(age, now)
        out += self.audience.notices(self.announcement, self._is_mine, now)
        out += self._flood.cries()
        if now >= self._flooded_at:
            self._flooded_at = math.inf
            self._notify()
        return out

    def answered(self, errand: Errand, now: float) -> None:
        """Record that a message was confirmed."""
        if isinstance(errand, Notice):
            self.audience.answered(errand)
        elif isinstance(errand, Offer):
            if errand.is_straight:
                self._check.answered(self.announcement, now)
            elif errand.is_shared:
                self._direct.answered(errand)
            else:
                self._gatherer.answered(errand, now)

    def failed(self, errand: Errand, now: float) -> None:
        """Record that a message was not answered."""
        if isinstance(errand, Notice):
            self.audience.failed(errand, now)
        elif isinstance(errand, Offer):
            if errand.is_straight:
                self._check.failed(errand.to, now)
            elif errand.is_shared:
                self._direct.failed(errand, now)
            else:
                self._gatherer.failed(errand, now)
            is_alone = self._check.is_alone or self._direct.is_alone or self._branch.is_alone
            if is_alone and self._teller is None:
                self._flood_own_bid(now)

    @property
    def _is_mine(self) -> bool:
        """Whether the current announcement is this node's own."""
        return self.announcement is not None and self.announcement.rank == self._rank

    def _flood_own_bid(self, now: float) -> None:
        """Flood the own bid, since no quorum member is reachable."""
        own = self._check.own
        if own is not None and not self.auction.exclusive and self._flood.join([own]):
            self._flooded_at = min(self._flooded_at, max(now, self._first_at + self.auction.waiting))

    def _notify(self) -> None:
        """Report the announced and flooded reports that stand, if they have changed."""
        announced = self.announcement.reports if self.announcement is not None else ()
        cried = self._flood.summary.standing
        reports = self._rule.merged(announced, cried) if cried else announced
        if reports != self.told:
            self.told = reports
            self._on_summary(reports)
