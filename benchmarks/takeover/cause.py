"""Causes of a failure of the acting robot, the results of a trial, and the observer that records them."""

from __future__ import annotations

import random
from collections.abc import Collection
from dataclasses import dataclass
from enum import Enum

from middleware.tasks.task import COMPLETED, Result

WEB, WITNESSES = "page", ("witness1", "witness2")
"""The nodes besides the bootstrap node and the robots. With seven members, three may fail at the same time, and the
other four are still a majority."""
PHASE_S = (0.2, 2.0)
"""Seconds from the first motion to the failure: at a random time of a renewal period, before the task is done."""
FROZEN_S = (3.0, 5.0)
"""Seconds for which a node is frozen: at least the duration of two leases."""


class Cause(Enum):
    """The fault of the acting robot."""

    CRASH = "crash"
    FREEZE = "freeze"
    LOST_RADIO = "lost radio"
    ONE_WAY_RADIO = "one-way radio"
    LOST_LINK = "lost link"
    POLITE_LEAVE = "polite leave"
    TRIPLE_KILL = "triple kill"


VIRTUAL_ONLY = frozenset({Cause.LOST_LINK})
"""Causes that are tested in virtual time only; with processes the demonstration tests this (``--lose link``)."""
DESCRIPTIONS = {
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
    """The result of one failure.

    ``takeover`` has the seconds from the failure until another robot moves, None if none moved; ``done`` whether the
    task was completed, by ``by``; ``overlaps`` the number of samples in which two robots moved at the same time,
    ``zombies`` the number of samples in which the failed robot moved after another had taken over.
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
    def has_passed(self) -> bool:
        """Whether another robot completed the task, and no two robots acted at the same time."""
        return self.done and self.by not in ("", self.lost) and self.takeover is not None and not self.violation_count

    @property
    def violation_count(self) -> int:
        """Samples in which a robot moved without permission."""
        return self.overlaps + self.zombies


POLL_S = 0.01


class TakeoverObserver:
    """Observer of a trial in which ``lost`` failed at ``began``; ``rng`` draws the duration of a freeze.

    The trial ends ``limit`` seconds after the failure, or ``after`` seconds after the end of the task was observed.
    """

    def __init__(
        self, cause: Cause, seed: int, lost: str, began: float, rng: random.Random, limit: float, after: float = 0.0
    ) -> None:
        self.takeover: float | None = None
        self.result: Result | None = None
        self._cause, self._seed, self._lost, self._began = cause, seed, lost, began
        self._thaw_at = began + rng.uniform(*FROZEN_S) if cause is Cause.FREEZE else None
        self._end, self._after = began + limit, after
        self._overlaps = self._zombies = 0

    def is_over(self, now: float) -> bool:
        """Return whether the observation is complete; never while the failed node is frozen."""
        return now >= self._end and self._thaw_at is None

    def take_thaw(self, now: float) -> bool:
        """Return whether the failed node has to continue now; true once."""
        if self._thaw_at is None or now < self._thaw_at:
            return False
        self._thaw_at = None
        return True

    def record(self, now: float, moving: Collection[str], result: Result | None) -> None:
        """Record the moving robots, and the result of the task if it is known."""
        self._overlaps += len(moving) > 1
        if self.takeover is not None:
            self._zombies += self._lost in moving
        elif any(name != self._lost for name in moving):
            self.takeover = now - self._began
        if result is not None:
            self._end = now + self._after if self.result is None else self._end
            self.result = result

    def make_trial(self) -> Trial:
        """Return the result of the trial."""
        by, done = ("", False) if self.result is None else (self.result.by, self.result.outcome == COMPLETED)
        cause = self._cause.value
        return Trial(cause, self._seed, self._lost, by, done, self.takeover, self._overlaps, self._zombies)
