"""One node of the tree in which bids are forwarded to the task's key (convergecast); pure.

The node merges the bids of its children and sends them to its parent, a contact nearer to the key, which confirms them.
If the parent does not answer, the node tries the next nearest contact, and finally the quorum members.  Nodes nearer to
the key wait longer, so that they can forward all bids in one message.  The tree resembles the tree of Scribe, but its
links are not stored.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable

from middleware.consensus.bidding.auction import Auction
from middleware.consensus.bidding.bid import Bid
from middleware.consensus.bidding.merge_rule import MergeRule
from middleware.consensus.bidding.outgoing_message import MAX_BIDS_PER_MESSAGE, Offer
from middleware.consensus.bidding.summary import Summary
from middleware.entangled.contact import Contact
from middleware.entangled.kademlia.distance import distance, select_closest

HOLD_PER_BIT_S = 0.02
"""Seconds to wait for each bit that the node's id shares with the key; a hop adds three bits and takes at least 30
ms."""
HOLD_SHARE = 0.5
"""Maximum time to wait, as a share of the waiting period."""
LATE_BIDS_S = 0.05
"""Seconds for which bids that arrive after the first message are collected."""
RETRY_PAUSE_S, MAX_RETRY_PAUSE_S = 1.0, 30.0
"""Seconds after which all contacts are tried again when none of them answered: first and maximum value, doubled each
time."""


MAX_CHILDREN = 64
"""Maximum number of children of a node that is not a quorum member; further nodes use their next contact.

A node that joined early is a contact of far more nodes than a node that joined late.  Without this limit, 340 of 10,000
nodes would send their bids to the same early node near the key.
"""


MAX_HOPS = 4
"""Maximum number of contacts that are tried before the quorum members."""


def find_hops(auction: Auction, own_id: bytes, contacts: Iterable[Contact]) -> list[Contact]:
    """Return the possible parents in the order in which to try them: contacts nearest to the key, then quorum members.

    Only contacts nearer to the key than this node are used, so bids do not circulate (Kademlia, section 2).  If the
    nearest contact is a quorum member, it is first and the other members follow.
    """
    own = distance(own_id, auction.key)
    nearer = [c for c in contacts if distance(c.node_id, auction.key) < own]
    found = select_closest(nearer, auction.key, MAX_HOPS)
    council = [member for member in auction.council if member.node_id != own_id]
    if found and auction.find_rank(found[0].node_id) is not None:
        return [found[0], *(member for member in council if member.node_id != found[0].node_id)]
    return [*(c for c in found if auction.find_rank(c.node_id) is None), *council]


def count_shared_bits(a: bytes, b: bytes) -> int:
    """Return the length in bits of the common prefix of two ids."""
    return 8 * len(a) - distance(a, b).bit_length()


class TreeNode:
    """Forwards bids at the node ``own_id``, which is not a quorum member.

    ``contacts`` returns the node's contacts.
    """

    def __init__(
        self, auction: Auction, own_id: bytes, rule: MergeRule, contacts: Callable[[], Iterable[Contact]]
    ) -> None:
        self.summary = Summary(rule)
        self.is_isolated = False
        self._auction = auction
        self._own_id = own_id
        self._contacts = contacts
        bits = count_shared_bits(own_id, auction.key)
        self._hold_s = min(HOLD_PER_BIT_S * bits, auction.waiting_period * HOLD_SHARE)
        self._parent: Contact | None = None
        self._failed_parents: set[bytes] = set()
        self._confirmed: dict[str, tuple[int, bytes]] = {}
        self._in_flight: Offer | None = None
        self._send_at = math.inf
        self._has_sent = False
        self._rounds = 0

    @property
    def due(self) -> float:
        """The time of the next message."""
        return math.inf if self._in_flight is not None else self._send_at

    def join(self, bids: Iterable[Bid], now: float) -> None:
        """Add bids that have to be forwarded."""
        if self.summary.join(bids):
            self._send_at = min(self._send_at, now + (LATE_BIDS_S if self._has_sent else self._hold_s))

    def take_due_offers(self, age: float, now: float) -> list[Offer]:
        """Return the message that is due now."""
        if now < self.due:
            return []
        self._send_at = math.inf
        unconfirmed = tuple(b for b in self.summary.list_bids() if self._confirmed.get(b.agent) != b.rank)
        parent = self._parent if self._parent is not None else self._find_next_parent()
        if not unconfirmed or parent is None:
            return []
        self._parent, self._has_sent = parent, True
        self._in_flight = Offer(parent, unconfirmed[:MAX_BIDS_PER_MESSAGE], age)
        return [self._in_flight]

    def on_answer(self, offer: Offer, now: float) -> None:
        """Record that the parent confirmed the bids."""
        self.is_isolated, self._rounds = False, 0
        self._on_sent(offer, now)
        self._confirmed.update((bid.agent, bid.rank) for bid in offer.bids)

    def on_failure(self, offer: Offer, now: float) -> None:
        """Record that the parent did not answer; all bids are sent to the next parent."""
        self._on_sent(offer, now)
        self._failed_parents.add(offer.to.node_id)
        self._confirmed.clear()
        self._parent = self._find_next_parent()
        self._send_at = now
        if self._parent is None:
            self.is_isolated = True
            self._failed_parents.clear()
            self._send_at = now + min(MAX_RETRY_PAUSE_S, RETRY_PAUSE_S * 2.0 ** min(self._rounds, 8))
            self._rounds += 1

    def _on_sent(self, offer: Offer, now: float) -> None:
        if offer is self._in_flight:
            self._in_flight = None
            sent = {bid.agent: bid.rank for bid in offer.bids}
            known = {**self._confirmed, **sent}
            if any(known.get(bid.agent) != bid.rank for bid in self.summary.list_bids()):
                self._send_at = min(self._send_at, now + LATE_BIDS_S)

    def _find_next_parent(self) -> Contact | None:
        known = find_hops(self._auction, self._own_id, self._contacts())
        return next((contact for contact in known if contact.node_id not in self._failed_parents), None)
