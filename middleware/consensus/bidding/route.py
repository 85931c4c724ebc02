"""Route: where a node sends what it has gathered; pure.

Each hop is nearer to the task's key than the one before (Kademlia, section 2), so there is no way round in a circle,
and nobody has to know the tree.
"""

from __future__ import annotations

from collections.abc import Iterable

from middleware.consensus.bidding.auction import Auction
from middleware.entangled.contact import Contact
from middleware.entangled.kademlia.distance import closest, distance

MAX_HOPS = 4
"""Contacts that are tried before the council itself."""


def hops(auction: Auction, own_id: bytes, contacts: Iterable[Contact]) -> list[Contact]:
    """Whom to send to, in the order of trying: the nearest contacts to the key, then the council.

    Only contacts nearer than this node count.  Where the nearest is a member of the council it is the goal, and the
    other members follow.
    """
    own = distance(own_id, auction.key)
    nearer = [c for c in contacts if distance(c.node_id, auction.key) < own]
    found = closest(nearer, auction.key, MAX_HOPS)
    council = [member for member in auction.council if member.node_id != own_id]
    if found and auction.rank(found[0].node_id) is not None:
        return [found[0], *(member for member in council if member.node_id != found[0].node_id)]
    return [*(c for c in found if auction.rank(c.node_id) is None), *council]


def shared_bits(a: bytes, b: bytes) -> int:
    """How many of the first bits two ids share."""
    return 8 * len(a) - distance(a, b).bit_length()
