"""One agent's execution of one task, which continues after interruptions; pure.

A behaviour is called with the fencing token under which it acts.  The same token means "continue". With a new token
other agents may have acted since the last call, and the behaviour decides whether to start again. This module also
detects a lack of progress.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from agents.behaviour import Behaviour
from agents.context import Context
from drivers.reading import Action, Observation
from middleware.consensus.strategy import Consensus

MIN_PROGRESS = 0.01
"""Minimum increase of the progress (0 to 1) that is not regarded as a stall."""
MAX_PAUSE_S = 1.0
"""A pause of more than this many seconds between two calls is not counted as time without progress."""
PROGRESS_STEP = 0.25
"""Progress is reported in steps of this size."""


@dataclass(frozen=True)
class Step:
    """The next action (None: the task is done), and the progress from 0 to 1 if the behaviour reports progress."""

    action: Action | None
    progress: float | None


class Execution:
    """The execution of one ``behaviour``; ``stall_limit`` is the time in seconds without progress (0: unlimited)."""

    def __init__(self, behaviour: Behaviour, stall_limit: float) -> None:
        self._behaviour = behaviour
        self._stall_limit = stall_limit
        self._token = 0
        self._began_at = 0.0
        self._best_progress = -math.inf
        self._best_at = 0.0
        self._stalled_at = -math.inf
        self._agreement: tuple[tuple[float, ...], str] = (), ""
        self._called_at = 0.0

    def look(self, seen: Observation, now: float) -> None:
        """Pass an observation to the behaviour."""
        self._behaviour.look(seen, now)

    def step_without_lease(self, is_searching: bool, now: float) -> Action:
        """Return the next action without a lease: search for the data on which the cost depends, or hold."""
        return self._behaviour.search(now) if is_searching else self._behaviour.hold(now)

    def step(self, now: float, token: int, deadline: float, consensus: Consensus | None = None) -> Step:
        """Continue under the lease with ``token``; ``consensus`` is the current decision."""
        is_resumed = token == self._token
        if now - self._called_at > MAX_PAUSE_S:
            self._best_at += now - self._called_at
        self._called_at = now
        if not is_resumed:
            self._token, self._began_at, self._best_progress, self._best_at = token, now, -math.inf, now
            self._agreement = (), ""
        if consensus is not None and (consensus.value or consensus.choice):
            self._agreement = consensus.value, consensus.choice
        action = self._behaviour.execute(Context(now, token, deadline, self._began_at, is_resumed, *self._agreement))
        progress = getattr(self._behaviour, "progress", None)
        if not isinstance(progress, int | float) or not math.isfinite(progress):
            return Step(action, None)
        progress = min(1.0, max(0.0, progress))
        if progress >= self._best_progress + MIN_PROGRESS:
            self._best_progress, self._best_at = progress, now
        elif 0.0 < self._stall_limit < now - self._best_at:
            self._stalled_at, self._best_at = now, now
        return Step(action, math.floor(max(progress, self._best_progress) / PROGRESS_STEP + 1e-9) * PROGRESS_STEP)

    def has_stalled(self, now: float) -> bool:
        """Return whether a stall, ``stall_limit`` seconds without progress, was detected recently.

        For ``stall_limit`` seconds after the detection another agent may execute the task.
        """
        return now - self._stalled_at < self._stall_limit

    @property
    def is_safe(self) -> bool:
        """Whether the task may be reassigned now; default True."""
        return bool(getattr(self._behaviour, "is_safe", True))
