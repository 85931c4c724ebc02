"""Direct: a bidder of a small team tells its bid to every member of the council, each until it confirms; pure."""

from __future__ import annotations

import math

from middleware.consensus.bidding.auction import Auction
from middleware.consensus.bidding.bid import Bid
from middleware.consensus.bidding.errand import Offer

MAX_TRIES = 3
"""Errands to one member for one bid; after them the announcement tells whether the others had it."""
PAUSE = 0.5


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
            self._owed[offer.to.node_id] = (tries + 1, now + PAUSE)
