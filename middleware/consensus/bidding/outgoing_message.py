"""Outgoing messages of an auction, with or without acknowledgement; pure."""

from __future__ import annotations

from dataclasses import dataclass

from middleware.consensus.bidding.announcement import Announcement
from middleware.consensus.bidding.bid import Bid
from middleware.entangled.contact import Contact

MAX_BIDS_PER_MESSAGE = 64
"""Maximum number of bids in one message; checking the signatures of so many bids takes 5 ms.

Further bids go into the next message.
"""


@dataclass(frozen=True, eq=False)
class Offer:
    """Bids that are sent to ``to``.

    - ``age``: seconds since the first known bid of the auction
    - ``is_shared``: the bidder itself sends its bid to every quorum member
    - ``is_inquiry``: the sender has no announcement, or an announcement that does not take its bid into account
    """

    to: Contact
    bids: tuple[Bid, ...]
    age: float
    is_shared: bool = False
    is_inquiry: bool = False


@dataclass(frozen=True, eq=False)
class Notice:
    """The announcement that is sent to ``to``."""

    to: Contact
    announcement: Announcement


@dataclass(frozen=True, eq=False)
class FloodedBids:
    """Bids flooded to a neighbour, without acknowledgement, because no quorum member is reachable."""

    to: Contact
    bids: tuple[Bid, ...]


OutgoingMessage = Offer | Notice | FloodedBids
