"""The ways in which the one that acts is lost, what is counted of each trial, and the judge that watches one."""

from __future__ import annotations

import random
from collections.abc import Collection
from dataclasses import dataclass
from enum import Enum

from middleware.tasks.task import COMPLETED, Result

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


LOOK_S = 0.01


class Judge:
    """What was seen since ``lost`` was lost at ``began``; ``dice`` say for how long it is frozen, if that is the cause.

    The trial ends ``limit`` seconds after the loss, or ``after`` seconds after its end was seen.
    """

    def __init__(
        self, cause: Cause, seed: int, lost: str, began: float, dice: random.Random, limit: float, after: float = 0.0
    ) -> None:
        self.takeover: float | None = None
        self.result: Result | None = None
        self._cause, self._seed, self._lost, self._began = cause, seed, lost, began
        self._thaw_at = began + dice.uniform(*FROZEN_S) if cause is Cause.FREEZE else None
        self._end, self._after = began + limit, after
        self._overlaps = self._zombies = 0

    def is_over(self, now: float) -> bool:
        """Whether nothing more is to be seen; never while the lost one is frozen."""
        return now >= self._end and self._thaw_at is None

    def thaws(self, now: float) -> bool:
        """Whether the lost one is to go on now; true once."""
        if self._thaw_at is None or now < self._thaw_at:
            return False
        self._thaw_at = None
        return True

    def look(self, now: float, moving: Collection[str], result: Result | None) -> None:
        """Take in who moves now, and how the task ended, if that is seen."""
        self._overlaps += len(moving) > 1
        if self.takeover is not None:
            self._zombies += self._lost in moving
        elif any(name != self._lost for name in moving):
            self.takeover = now - self._began
        if result is not None:
            self._end = now + self._after if self.result is None else self._end
            self.result = result

    def verdict(self) -> Trial:
        """What came of the loss."""
        by, done = ("", False) if self.result is None else (self.result.by, self.result.outcome == COMPLETED)
        cause = self._cause.value
        return Trial(cause, self._seed, self._lost, by, done, self.takeover, self._overlaps, self._zombies)
