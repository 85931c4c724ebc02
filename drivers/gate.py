"""Check fencing tokens and deadlines of the commands to one robot.

The code is pure: the time is an argument. A driver checks each command before sending it. A robot with a gate, or its
emulator, checks the command again on arrival, so the robot stops by itself if its node freezes.
"""

from __future__ import annotations

import math

from drivers.driver import Permit
from drivers.errors import StaleCommand

LOWER, LATE = "lower token", "late"
"""Reasons to refuse a command: its token is lower than the highest seen, or its deadline has passed."""


class Gate:
    """The highest token seen, and the deadline of the last accepted command.

    A robot has one gate for all links as long as it runs: a new connection does not make an old token valid again.
    Tokens of different tasks are compared with each other. ``accepted`` counts the accepted commands, ``refused`` the
    refused commands by reason.
    """

    def __init__(self) -> None:
        self.accepted = 0
        self.refused = {LOWER: 0, LATE: 0}
        self._token: int | None = None
        self._deadline: float | None = None

    @property
    def token(self) -> int | None:
        """The highest token that was accepted or learned, None before the first."""
        return self._token

    @property
    def deadline(self) -> float | None:
        """The time at which the motion must end; None while no motion is in force."""
        return self._deadline

    def learn(self, token: int) -> None:
        """Adopt a token that the robot's own gate reports, and refuse lower tokens from now on."""
        if token > (self._token or 0):
            self._token = token

    def admit(self, permit: Permit, now: float) -> None:
        """Accept a command; raise ``StaleCommand`` if its token is lower than the highest seen or it is too late."""
        if not math.isfinite(permit.deadline) or permit.deadline <= now:
            self.refused[LATE] += 1
            late = now - permit.deadline
            raise StaleCommand(f"the deadline of token {permit.token} passed {late:.3f} s ago; take a new lease")
        if self._token is not None and permit.token < self._token:
            self.refused[LOWER] += 1
            raise StaleCommand(
                f"token {permit.token} is lower than token {self._token}, which was obeyed earlier; take a new lease"
            )
        self.accepted += 1
        self._token = permit.token
        self._deadline = permit.deadline

    def is_motion_over(self, now: float) -> bool:
        """Return whether the motion in force has reached its deadline and must be stopped now."""
        return self._deadline is not None and now >= self._deadline

    def end_motion(self) -> None:
        """Clear the motion in force after a stop; the highest token is kept, so that older tokens are still refused."""
        self._deadline = None
