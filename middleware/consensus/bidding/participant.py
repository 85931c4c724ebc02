"""The participation of one node in one auction: it bids, forwards bids, or announces the best bids; pure.

``take_due_messages`` returns the outgoing messages, and ``due`` is the time at which it has to be called next.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Iterable

from middleware.consensus.bidding.announcement import Announcement
from middleware.consensus.bidding.announcer import Announcer
from middleware.consensus.bidding.auction import Auction
from middleware.consensus.bidding.bid import Bid
from middleware.consensus.bidding.bid_delivery import BidCheck, DirectSender
from middleware.consensus.bidding.flood import Flood
from middleware.consensus.bidding.merge_rule import MergeRule
from middleware.consensus.bidding.outgoing_message import Notice, Offer, OutgoingMessage
from middleware.consensus.bidding.path_choice import DIRECT
from middleware.consensus.bidding.recipients import Recipients
from middleware.consensus.bidding.summary import Summary
from middleware.consensus.bidding.tree import MAX_CHILDREN, TreeNode
from middleware.consensus.strategy import Report
from middleware.entangled.contact import Contact

RELAY_DELAY_S = 0.4
"""A forwarding node requests the announcement after this number of seconds of silence, earlier than the nodes of its
subtree."""

MAX_REVISION = 2**32
"""Upper bound of valid revisions; a node ignores a higher announced revision, because it must be forged."""

OnSummary = Callable[[tuple[Report, ...]], None]
"""Called with the best reports after each change."""


class Participant:
    """The participation of the node ``me`` in ``auction``.

    ``sign`` returns a signature of this node, and ``contacts`` returns its contacts.
    """

    def __init__(
        self,
        auction: Auction,
        me: Contact,
        rule: MergeRule,
        contacts: Callable[[], Iterable[Contact]],
        rng: random.Random,
        sign: Callable[[bytes], bytes],
        on_summary: OnSummary,
    ) -> None:
        self.auction = auction
        self.announcement: Announcement | None = None
        self.recipients = Recipients()
        self._on_summary = on_summary
        self._me = me
        self._rule = rule
        self._rank = auction.find_rank(me.node_id)
        self._announcer = Announcer(auction, self._rank, rule, sign) if self._rank is not None else None
        self._tree_node = TreeNode(auction, me.node_id, rule, contacts)
        self._collector: Announcer | TreeNode = self._announcer or self._tree_node
        self._bid_check = BidCheck(auction, me.node_id, rule, rng)
        self._direct_sender = DirectSender(auction, me.node_id)
        self._flood = Flood(me.node_id, rule, contacts, rng)
        self._flood_result_at = math.inf
        self.standing_reports: tuple[Report, ...] = ()
        self.next_revision = 0
        self._first_bid_at = math.inf
        self._is_relay = False
        if self._announcer is not None:
            for member in auction.council:
                if member.node_id != me.node_id:
                    self.recipients.add(member, is_shared=True)

    @property
    def summary(self) -> Summary:
        """The bids that this node has collected."""
        return self._collector.summary

    @property
    def due(self) -> float:
        """The time of the next message."""
        notices_at = self.recipients.compute_due(self.announcement, self._is_mine)
        checked_at = self._bid_check.due if self._announcer is None else math.inf
        return min(self._direct_sender.due, self._flood_result_at, notices_at, self._collector.due, checked_at)

    @property
    def own_bid(self) -> Bid | None:
        """The last bid of this node's own agent."""
        return self._bid_check.own_bid

    @property
    def is_superseded(self) -> bool:
        """Whether the agent has to bid again: a bid of its earlier run, with a higher revision, was announced."""
        return self.own_bid is not None and self.own_bid.revision < self.next_revision - 1

    def expect_bidders(self, bidders: float) -> None:
        """Close the bidding as soon as ``bidders`` agents have bid or abstained."""
        if self._announcer is not None:
            self._announcer.expected_bidders = bidders

    def make_bid(self, bid: Bid, path: str, now: float) -> None:
        """Make or withdraw this node's own bid; ``path`` is a path of ``path_choice``."""
        self._first_bid_at = min(self._first_bid_at, now)
        self.next_revision = max(self.next_revision, bid.revision + 1)
        is_direct = path == DIRECT
        if is_direct:
            self._direct_sender.send_bid(bid, now)
        if self._announcer is not None:
            self._announcer.join([bid], self._me.node_id, is_direct, now - self._first_bid_at, now)
        elif not is_direct:
            self._tree_node.join([bid], now)
        self._bid_check.check_bid(bid, self.announcement, is_direct, now)
        if self._flood_result_at != math.inf or self._flood.summary.standing:
            self._flood_own_bid(now)

    def has_room(self, sender: Contact) -> bool:
        """Return whether this node accepts bids of ``sender``.

        Quorum members accept bids of all nodes, other nodes only bids of a limited number of nodes.
        """
        return self._announcer is not None or len(self.recipients) < MAX_CHILDREN or self.recipients.has(sender)

    def on_offer(
        self, bids: Iterable[Bid], sender: Contact, age: float, is_shared: bool, now: float
    ) -> Announcement | None:
        """Process the bids of ``sender``; return the announcement, or None if there is none yet."""
        self._first_bid_at = min(self._first_bid_at, now - age)
        self.recipients.add(sender, is_shared and self._announcer is not None)
        if self._announcer is not None:
            self._announcer.join(bids, sender.node_id, is_shared, age, now)
        else:
            self._tree_node.join(bids, now)
            if not self._is_relay and self.announcement is None:
                self._is_relay = True
                self._bid_check.expect_announcement(self._first_bid_at, RELAY_DELAY_S)
        if self.announcement is not None:
            self.recipients.record_known(sender, self.announcement)
        return self.announcement

    def on_announcement(self, announcement: Announcement, now: float) -> None:
        """Process a verified announcement; ignore it if it is older than the known one."""
        if self.announcement is not None and announcement.precedence <= self.announcement.precedence:
            return
        self.announcement = announcement
        if self._announcer is not None:
            self._announcer.on_announcement(announcement)
        self._bid_check.on_announcement(announcement, now)
        for entry in announcement.entries:
            if entry.report.agent == self._me.node_id.hex() and entry.revision < MAX_REVISION:
                own = self.own_bid
                is_mine = own is not None and (own.revision, own.report) == (entry.revision, entry.report)
                self.next_revision = max(self.next_revision, entry.revision + (1 if is_mine else 2))
        self._notify()

    def on_flood(self, bids: Iterable[Bid], sender: Contact, now: float) -> None:
        """Process flooded bids; ignore them if the task is exclusive."""
        if self.auction.exclusive:
            return
        self._first_bid_at = min(self._first_bid_at, now)
        if self._flood.join(bids, sender):
            if self._bid_check.own_bid is not None:
                self._flood.join([self._bid_check.own_bid])
            self._flood_result_at = min(
                self._flood_result_at, max(now, self._first_bid_at + self.auction.waiting_period)
            )

    def take_due_messages(self, now: float) -> list[OutgoingMessage]:
        """Return the messages that are due now."""
        age = max(0.0, now - self._first_bid_at) if self._first_bid_at != math.inf else 0.0
        out: list[OutgoingMessage] = []
        if self._announcer is not None:
            new_announcement = self._announcer.make_due_announcement(self.announcement, self.recipients.is_shared, now)
            if new_announcement is not None:
                self.on_announcement(new_announcement, now)
        out += self._collector.take_due_offers(age, now)
        if self._announcer is None:
            out += self._bid_check.take_due_offers(self.announcement, age, now)
        out += self._direct_sender.take_due_offers(age, now)
        out += self.recipients.take_due_notices(self.announcement, self._is_mine, now)
        out += self._flood.take_due_messages()
        if now >= self._flood_result_at:
            self._flood_result_at = math.inf
            self._notify()
        return out

    def on_answer(self, message: OutgoingMessage, now: float) -> None:
        """Record that a message was confirmed."""
        if isinstance(message, Notice):
            self.recipients.on_answer(message)
        elif isinstance(message, Offer):
            if message.is_inquiry:
                self._bid_check.on_answer(self.announcement, now)
            elif message.is_shared:
                self._direct_sender.on_answer(message)
            else:
                self._collector.on_answer(message, now)

    def on_failure(self, message: OutgoingMessage, now: float) -> None:
        """Record that a message was not answered."""
        if isinstance(message, Notice):
            self.recipients.on_failure(message, now)
        elif isinstance(message, Offer):
            if message.is_inquiry:
                self._bid_check.on_failure(message.to, now)
            elif message.is_shared:
                self._direct_sender.on_failure(message, now)
            else:
                self._collector.on_failure(message, now)
            is_alone = self._bid_check.is_isolated or self._direct_sender.is_isolated or self._tree_node.is_isolated
            if is_alone and self._announcer is None:
                self._flood_own_bid(now)

    @property
    def _is_mine(self) -> bool:
        """Whether this node made the current announcement."""
        return self.announcement is not None and self.announcement.rank == self._rank

    def _flood_own_bid(self, now: float) -> None:
        """Flood this node's own bid, because no quorum member is reachable."""
        own = self._bid_check.own_bid
        if own is not None and not self.auction.exclusive and self._flood.join([own]):
            self._flood_result_at = min(
                self._flood_result_at, max(now, self._first_bid_at + self.auction.waiting_period)
            )

    def _notify(self) -> None:
        """Call ``on_summary`` with the best of the announced and flooded reports, if these have changed."""
        announced = self.announcement.reports if self.announcement is not None else ()
        cried = self._flood.summary.standing
        reports = self._rule.merge(announced, cried) if cried else announced
        if reports != self.standing_reports:
            self.standing_reports = reports
            self._on_summary(reports)
