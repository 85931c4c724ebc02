"""Outgoing messages of an auction, with or without acknowledgement; pure."""

from __future__ import annotations

from dataclasses import dataclass

from middleware.consensus.bidding.announcement import Announcement
from middleware.consensus.bidding.bid import Bid
from middleware.entangled.contact import Contact

MAX_BIDS_PER_MESSAGE = 64
"""Maximum number of bids in one message: checking their signatures takes 5 ms.

Further bids go into the next message.
"""


@dataclass(frozen=True, eq=False)
class Offer:
    """Bids for ``to``.

    - ``age``: the seconds since the first known bid was made
    - ``is_shared``: the bidder itself sends to every quorum member
    - ``is_inquiry``: the sender asks a quorum member for a missing announcement, or its bid is missing there
    """

    to: Contact
    bids: tuple[Bid, ...]
    age: float
    is_shared: bool = False
    is_inquiry: bool = False


@dataclass(frozen=True, eq=False)
class Notice:
    """The announcement for ``to``."""

    to: Contact
    announcement: Announcement


@dataclass(frozen=True, eq=False)
class FloodedBids:
    """Flooded bids for a neighbour while no quorum member is reachable, without acknowledgement."""

    to: Contact
    bids: tuple[Bid, ...]


OutgoingMessage = Offer | Notice | FloodedBids
