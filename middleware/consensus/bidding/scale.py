"""Scale: which way the bids of a team of this size go, without going back and forth at the border; pure."""

from __future__ import annotations

from collections.abc import Iterable

from middleware.entangled.contact import Contact
from middleware.entangled.identity import ID_BYTES
from middleware.entangled.kademlia.distance import distance

DIRECT, TREE = "direct", "tree"
MOST_DIRECT = 30
"""Bidders up to whom each of them tells the whole council: 3 members then hear 90 bids."""
LEAST_TREE = 24
"""Bidders from whom on a team that once was larger stays with the tree."""


class Scale:
    """Begins with the direct way."""

    def __init__(self) -> None:
        self.way = DIRECT

    def counted(self, bidders: int) -> str:
        """The way for that many bidders, given the way so far."""
        if bidders > MOST_DIRECT:
            self.way = TREE
        elif bidders < LEAST_TREE:
            self.way = DIRECT
        return self.way


WHOLE = 50
"""Up to that many contacts are taken for everybody, in a network that is not large: a roster holds 64."""
NEAR = 8
"""Contacts by whose distance a large team is measured: a node knows its k nearest for certain."""


def team_size(own_id: bytes, contacts: Iterable[Contact], is_large: bool) -> int:
    """About how many nodes there are, this one included: as many as are known, or more where those known lie dense.

    Ids are spread evenly, so of N nodes the n-th nearest is about n / N of the whole range away.  In a network that
    ``is_large`` hardly anybody knows all, and a newcomer knows few.
    """
    apart = sorted(distance(own_id, contact.node_id) for contact in contacts)
    known = len(apart) + 1
    if len(apart) < NEAR or (len(apart) <= WHOLE and not is_large):
        return known
    return max(known, NEAR * (1 << (8 * ID_BYTES)) // max(1, apart[NEAR - 1]))
