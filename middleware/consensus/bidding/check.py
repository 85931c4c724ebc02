"""How a bidder reaches the council: directly in a small team, and by a check that its bid counted; pure.

Trees lose whole branches with the node that holds them.  So a bidder that is announced nothing asks the council
itself, and one whose bid should have changed what was announced sends it there within half the waiting period.
"""

from __future__ import annotations

import math
import random

from middleware.consensus.bidding.announcement import Announcement
from middleware.consensus.bidding.auction import Auction
from middleware.consensus.bidding.bid import Bid
from middleware.consensus.bidding.errand import Offer
from middleware.consensus.bidding.rule import Rule
from middleware.entangled.contact import Contact

SILENCE = 0.6
"""Seconds after the waiting period within which the announcement comes down a tree of 10,000, losses included."""
SPREAD = 0.25
"""Share of the waiting period over which the questions of many are spread."""
LEAST_PAUSE, MOST_PAUSE = 0.5, 10.0
"""Seconds between two questions of one bidder, at least and, while nobody answers, at most."""
MAX_RELAYED = 3
"""Questions of a node that only has others' bids."""


class Check:
    """The own bid of one node and whether it counted; of a node that only has others' bids, whether it was told."""

    def __init__(self, auction: Auction, own_id: bytes, rule: Rule, rng: random.Random) -> None:
        self.own: Bid | None = None
        self.failures = 0
        self._auction = auction
        self._members = [member for member in auction.council if member.node_id != own_id]
        self._rule = rule
        self._rng = rng
        self._ask_at = math.inf
        self._is_asked = False
        self._is_strict = False
        self._relayed = 0

    @property
    def due(self) -> float:
        """When there is something to ask."""
        return math.inf if self._is_asked or not self._members else self._ask_at

    @property
    def is_alone(self) -> bool:
        """Whether every member of the council, one after the other, did not answer."""
        return self.failures >= len(self._members) > 0

    def bid(self, bid: Bid, announcement: Announcement | None, is_strict: bool, now: float) -> None:
        """Watch over ``bid``; with ``is_strict`` also where it changes only who stands by."""
        self.own, self._is_strict = bid, is_strict
        if announcement is None:
            if self._ask_at == math.inf:
                self.expect(now, SILENCE)
        elif not self.is_counted(announcement):
            self._ask_from(now + self._auction.waiting * SPREAD)

    def expect(self, since: float, silence: float) -> None:
        """Expect an announcement ``silence`` seconds after the waiting period that began at ``since``."""
        waiting = self._auction.waiting
        self._ask_from(since + waiting + silence)

    def heard(self, announcement: Announcement, now: float) -> None:
        """Compare what is announced with the own bid."""
        self._ask_at = math.inf
        if not self.is_counted(announcement):
            self._ask_from(now)

    def is_counted(self, announcement: Announcement) -> bool:
        """Whether the own bid, if there is one, is in the announcement, or would not have changed it."""
        if self.own is None:
            return True
        entry = next((e for e in announcement.entries if e.report.agent == self.own.agent), None)
        if entry is not None:
            return entry.revision >= self.own.revision
        if self.own.report is None:
            return True
        combined = self._rule.merged(announcement.reports, (self.own.report,))
        if self._is_strict and self.own.report in combined:
            return False
        return self._rule.decided(combined) == self._rule.decided(announcement.reports)

    def offers(self, announcement: Announcement | None, age: float, now: float) -> list[Offer]:
        """The question to the council, where it is time."""
        if now < self.due:
            return []
        self._ask_at = math.inf
        if announcement is not None and self.is_counted(announcement):
            return []
        if self.own is None:
            self._relayed += 1
            if self._relayed > MAX_RELAYED:
                return []
        self._is_asked = True
        member = self._members[self.failures % len(self._members)]
        return [Offer(member, (self.own,) if self.own is not None else (), age, is_straight=True)]

    def answered(self, announcement: Announcement | None, now: float) -> None:
        """A member of the council has the bid now; ``announcement`` is what this node knows."""
        self._is_asked = False
        self.failures = 0
        if announcement is None or not self.is_counted(announcement):
            self._ask_at = min(self._ask_at, now + max(LEAST_PAUSE, self._auction.waiting))

    def failed(self, to: Contact, now: float) -> None:
        """A member of the council did not answer: the next one is asked."""
        self._is_asked = False
        self.failures += 1
        self._ask_at = min(self._ask_at, now + (min(MOST_PAUSE, LEAST_PAUSE * self.failures) if self.is_alone else 0.0))

    def _ask_from(self, moment: float) -> None:
        self._ask_at = min(self._ask_at, moment + self._rng.uniform(0.0, self._auction.waiting * SPREAD))


MAX_TRIES = 3
"""Errands to one member for one bid; after them the announcement tells whether the others had it."""
RETRY_PAUSE_S = 0.5


class Direct:
    """What one bidder owes to each member of the council."""

    def __init__(self, auction: Auction, own_id: bytes) -> None:
        self._members = [member for member in auction.council if member.node_id != own_id]
        self._bid: Bid | None = None
        self._owed: dict[bytes, tuple[int, float]] = {}
        self._under_way: dict[bytes, Bid] = {}
        self._silent: set[bytes] = set()

    @property
    def is_alone(self) -> bool:
        """Whether every member that was to be told did not answer."""
        return 0 < len(self._members) <= len(self._silent)

    @property
    def due(self) -> float:
        """When there is something to send."""
        return min((at for node_id, (_, at) in self._owed.items() if node_id not in self._under_way), default=math.inf)

    def bid(self, bid: Bid, now: float) -> None:
        """Owe ``bid``, and nothing that went before it, to every member."""
        self._bid = bid
        self._owed = {member.node_id: (0, now) for member in self._members}

    def offers(self, age: float, now: float) -> list[Offer]:
        """What goes out now."""
        out: list[Offer] = []
        for member in self._members:
            _, at = self._owed.get(member.node_id, (0, math.inf))
            if self._bid is not None and at <= now and member.node_id not in self._under_way:
                self._under_way[member.node_id] = self._bid
                out.append(Offer(member, (self._bid,), age, is_shared=True))
        return out

    def answered(self, offer: Offer) -> None:
        """A member has confirmed."""
        self._silent.discard(offer.to.node_id)
        if self._under_way.pop(offer.to.node_id, None) is self._bid:
            self._owed.pop(offer.to.node_id, None)

    def failed(self, offer: Offer, now: float) -> None:
        """A member did not answer."""
        self._silent.add(offer.to.node_id)
        asked = self._under_way.pop(offer.to.node_id, None)
        tries, _ = self._owed.pop(offer.to.node_id, (0, now))
        if asked is not self._bid:
            self._owed[offer.to.node_id] = (0, now)
        elif tries + 1 < MAX_TRIES:
            self._owed[offer.to.node_id] = (tries + 1, now + RETRY_PAUSE_S)
