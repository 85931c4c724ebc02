"""Pace: how often the far contacts of a large network are asked whether they are still there; pure.

In a network that changes slowly nearly every question is in vain, in one that changes quickly a contact that nobody
asked for a minute is mostly gone.  So the pace follows what comes of it: the wait is halved for each contact that was
lost and grows a little with each that answers, and settles where ``GONE`` of those asked are gone.  After Kademlia's
and Bamboo's measurements lookups bear that many dead contacts without taking longer.
"""

from __future__ import annotations

LEAST, FIRST, MOST = 15.0, 60.0, 300.0
"""Seconds of silence after which a far contact is asked: where all come and go, at first, and where nobody does."""
GONE = 0.05
LONGER = 2.0 ** (GONE / (1 - GONE))
"""By what the wait grows with each answer."""


class Pace:
    """The wait of one node, in seconds."""

    __slots__ = ("wait",)

    def __init__(self) -> None:
        self.wait = FIRST

    def answered(self) -> None:
        """Take note that a contact which was silent for so long is still there."""
        self.wait = min(MOST, self.wait * LONGER)

    def lost(self) -> None:
        """Take note that a contact is gone."""
        self.wait = max(LEAST, self.wait / 2)
