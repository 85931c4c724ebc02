"""Execution: one agent's doing of one task, which outlives interruptions; pure.

A behaviour is told under which token it acts.  The same token means "go on"; a new one means that others may have
acted in between, and the behaviour decides what that means to it.  Whether the doing comes forward is watched here.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from agents.behaviour import Behaviour
from agents.context import Context
from drivers.reading import Action, Observation
from middleware.consensus.strategy import Consensus

SHARE = 0.01
"""Less progress than this is none."""
ASIDE = 1.0
"""Who is not asked for longer than this was kept from it, and has not stalled meanwhile."""
TOLD = 0.25
"""The others are told of each quarter."""


@dataclass(frozen=True)
class Turn:
    """What is to be done next (None: it is done), and the share that is done, where the behaviour can tell."""

    action: Action | None
    progress: float | None


class Execution:
    """The doing of one ``behaviour``; ``stall_limit`` in seconds without progress (0: any time)."""

    def __init__(self, behaviour: Behaviour, stall_limit: float) -> None:
        self._behaviour = behaviour
        self._stall_limit = stall_limit
        self._token = 0
        self._began = 0.0
        self._best = -math.inf
        self._best_at = 0.0
        self._stalled_at = -math.inf
        self._agreed: tuple[tuple[float, ...], str] = (), ""
        self._asked_at = 0.0

    def look(self, seen: Observation, now: float) -> None:
        """Take in what the body senses."""
        self._behaviour.look(seen, now)

    def stand_by(self, is_searching: bool, now: float) -> Action:
        """What to do without a lease: search for what the cost depends on, or hold."""
        return self._behaviour.search(now) if is_searching else self._behaviour.hold(now)

    def go_on(self, now: float, token: int, deadline: float, consensus: Consensus | None = None) -> Turn:
        """Do the next bit under the lease of ``token``; ``consensus`` is what all agree on."""
        is_resumed = token == self._token
        if now - self._asked_at > ASIDE:
            self._best_at += now - self._asked_at
        self._asked_at = now
        if not is_resumed:
            self._token, self._began, self._best, self._best_at = token, now, -math.inf, now
            self._agreed = (), ""
        if consensus is not None and (consensus.value or consensus.choice):
            self._agreed = consensus.value, consensus.choice
        action = self._behaviour.execute(Context(now, token, deadline, self._began, is_resumed, *self._agreed))
        progress = getattr(self._behaviour, "progress", None)
        if not isinstance(progress, int | float) or not math.isfinite(progress):
            return Turn(action, None)
        progress = min(1.0, max(0.0, progress))
        if progress >= self._best + SHARE:
            self._best, self._best_at = progress, now
        elif 0.0 < self._stall_limit < now - self._best_at:
            self._stalled_at, self._best_at = now, now
        return Turn(action, math.floor(max(progress, self._best) / TOLD + 1e-9) * TOLD)

    def has_stalled(self, now: float) -> bool:
        """Whether it came to nothing lately: another is to try, for as long as this one tried in vain."""
        return now - self._stalled_at < self._stall_limit

    @property
    def is_safe(self) -> bool:
        """Whether the task may change hands now; a behaviour that does not say is always at a safe point."""
        return bool(getattr(self._behaviour, "is_safe", True))
