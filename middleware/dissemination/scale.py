"""Scale: which way the bids of a team of this size go, without going back and forth at the border; pure."""

from __future__ import annotations

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
