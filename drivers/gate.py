"""Gate: who may move a robot now, and until when; the robot's own last word on fencing.

Pure: the moment is an argument.  A driver asks it before a command leaves, and a robot (or its stand-in) asks it when
a command arrives, so that a robot whose node froze stops by itself.
"""

from __future__ import annotations

import math

from drivers.driver import Permit
from drivers.errors import StaleCommand

LOWER, LATE = "lower token", "late"
"""Why a command is refused: its token is older than one seen, or its deadline is not ahead."""


class Gate:
    """The highest token seen, and the deadline of the last command let through.

    A gate serves one robot for as long as that robot runs, whoever holds the link: a new holder does not make an old
    token young again.  Tokens of different tasks are compared with each other.  ``accepted`` counts the commands that
    were let through, ``refused`` those that were not, by the reason.
    """

    def __init__(self) -> None:
        self.accepted = 0
        self.refused = {LOWER: 0, LATE: 0}
        self._token: int | None = None
        self._deadline: float | None = None

    @property
    def token(self) -> int | None:
        """The highest token that was let through or told, None before the first."""
        return self._token

    @property
    def deadline(self) -> float | None:
        """When the motion must end; None while nothing is in force."""
        return self._deadline

    def learn(self, token: int) -> None:
        """Take over what a gate further down has seen: from now on nothing lower is let through."""
        if token > (self._token or 0):
            self._token = token

    def admit(self, permit: Permit, now: float) -> None:
        """Let a command through, or raise ``StaleCommand``: token older than one seen, or deadline not ahead."""
        if not math.isfinite(permit.deadline) or permit.deadline <= now:
            self.refused[LATE] += 1
            late = now - permit.deadline
            raise StaleCommand(f"the deadline of token {permit.token} passed {late:.3f} s ago; take a new lease")
        if self._token is not None and permit.token < self._token:
            self.refused[LOWER] += 1
            raise StaleCommand(
                f"token {permit.token} is older than token {self._token}; someone else holds the task now"
            )
        self.accepted += 1
        self._token = permit.token
        self._deadline = permit.deadline

    def is_over(self, now: float) -> bool:
        """Whether the motion in force has reached its deadline and must be stopped now."""
        return self._deadline is not None and now >= self._deadline

    def close(self) -> None:
        """Forget the motion in force, because it was stopped; the token is kept, so that fencing holds."""
        self._deadline = None
