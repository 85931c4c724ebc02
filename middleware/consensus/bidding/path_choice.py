"""Choose the path of bids, direct or through a tree, by the size of the team and with hysteresis; pure."""

from __future__ import annotations

from collections.abc import Iterable

from middleware.entangled.contact import Contact
from middleware.entangled.identity import ID_BYTES
from middleware.entangled.kademlia.distance import distance

DIRECT, TREE = "direct", "tree"
MAX_DIRECT_BIDDERS = 30
"""Maximum number of bidders with the direct path; 3 quorum members then receive 90 bids in total."""
MIN_TREE_BIDDERS = 24
"""A team that has shrunk still uses the tree if it has at least this number of bidders."""


class PathChoice:
    """The current path; initially direct."""

    def __init__(self) -> None:
        self.path = DIRECT

    def choose(self, bidders: int) -> str:
        """Return the path for the given number of bidders; it also depends on the current path."""
        if bidders > MAX_DIRECT_BIDDERS:
            self.path = TREE
        elif bidders < MIN_TREE_BIDDERS:
            self.path = DIRECT
        return self.path


MAX_WHOLE_TEAM = 50
"""Maximum number of contacts that are assumed to be the whole team in a small network; a member table has 64
entries."""
NEAREST_CONTACTS = 8
"""Number of nearest contacts from which the size of a large team is estimated, because a node knows all of these."""


def estimate_team_size(own_id: bytes, contacts: Iterable[Contact], is_large: bool) -> int:
    """Estimate the number of nodes, including this one, from the density of known ids.

    Ids are uniformly distributed, so the n-th nearest of N nodes is about n / N of the key space away.  Set
    ``is_large`` in a network in which a node does not know all others.
    """
    distances = sorted(distance(own_id, contact.node_id) for contact in contacts)
    known = len(distances) + 1
    if len(distances) < NEAREST_CONTACTS or (len(distances) <= MAX_WHOLE_TEAM and not is_large):
        return known
    return max(known, NEAREST_CONTACTS * (1 << (8 * ID_BYTES)) // max(1, distances[NEAREST_CONTACTS - 1]))
