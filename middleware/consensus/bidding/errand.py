"""Errand: one message of an auction that is to be sent and acknowledged; pure."""

from __future__ import annotations

from dataclasses import dataclass

from middleware.consensus.bidding.announcement import Announcement
from middleware.consensus.bidding.bid import Bid
from middleware.entangled.contact import Contact

MAX_BIDS = 64
"""Bids in one message: to check their signatures takes 5 ms.  What is more goes in the next one."""


@dataclass(frozen=True, eq=False)
class Offer:
    """Bids for ``to``.  ``age`` is how many seconds ago the first bid that is known of was made.

    ``is_shared``: the bidder tells every member of the council itself.  ``is_straight``: it asks for the announcement,
    which did not come, or has a bid that the announcement should not have missed.
    """

    to: Contact
    bids: tuple[Bid, ...]
    age: float
    is_shared: bool = False
    is_straight: bool = False


@dataclass(frozen=True, eq=False)
class Notice:
    """The announcement for ``to``."""

    to: Contact
    announcement: Announcement


@dataclass(frozen=True, eq=False)
class Cry:
    """Bids for a neighbour while no council is in reach; nobody acknowledges it."""

    to: Contact
    bids: tuple[Bid, ...]


Errand = Offer | Notice | Cry
