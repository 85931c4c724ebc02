"""Cause: the ways in which the one that acts is lost, and what is counted of each trial."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

WEB, WITNESSES = "page", ("witness1", "witness2")
"""The nodes beside the bootstrap node and the dogs.  With seven members three may die at once, and four still agree."""
PHASE_S = (0.2, 2.0)
"""Seconds from the first move to the loss: anywhere in a period of renewal, and before the task is done."""
FROZEN_S = (3.0, 5.0)
"""Seconds that a frozen node stands still: two leases and more."""


class Cause(Enum):
    """What happens to the dog that acts."""

    CRASH = "crash"
    FREEZE = "freeze"
    LOST_RADIO = "lost radio"
    ONE_WAY_RADIO = "one-way radio"
    LOST_LINK = "lost link"
    POLITE_LEAVE = "polite leave"
    TRIPLE_KILL = "triple kill"


VIRTUAL = frozenset({Cause.LOST_LINK})
"""Those that are tried in virtual time only; with processes the demonstration shows it (``--lose link``)."""
SAYS = {
    Cause.CRASH: "its node dies (SIGKILL)",
    Cause.FREEZE: "its node stands still (SIGSTOP) for two leases and more, and goes on",
    Cause.LOST_RADIO: "nothing passes between it and the others",
    Cause.ONE_WAY_RADIO: "it hears the others, and they do not hear it",
    Cause.LOST_LINK: "nothing passes between its node and its robot",
    Cause.POLITE_LEAVE: "its node stops in order",
    Cause.TRIPLE_KILL: "it, the bootstrap node and the web node die at the same moment",
}


@dataclass(frozen=True)
class Trial:
    """What came of one loss.

    ``takeover`` is in seconds from the loss until another dog moves, None where none ever did; ``done`` whether the
    task was completed, by ``by``; ``overlaps`` counts the looks at which two dogs moved at once, ``zombies`` those at
    which the lost one moved after another had taken over.
    """

    cause: str
    seed: int
    lost: str
    by: str
    done: bool
    takeover: float | None
    overlaps: int
    zombies: int

    @property
    def held(self) -> bool:
        """Whether the task was completed by another, and no two ever acted at once."""
        return self.done and self.by not in ("", self.lost) and self.takeover is not None and not self.bad

    @property
    def bad(self) -> int:
        """Looks at which something moved that must not."""
        return self.overlaps + self.zombies
