"""Judge: watches one trial from the moment of the loss, in whatever time passes there, and says what came of it."""

from __future__ import annotations

import random
from collections.abc import Collection

from benchmarks.takeover.cause import FROZEN_S, Cause, Trial
from middleware.tasks.task import COMPLETED, Result

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
