"""Behaviour: how a body does one kind of task; pure, and loaded by name.

A behaviour sees observations and names actions.  It knows neither peers nor leases: whether it may act is decided outside.
"""

from __future__ import annotations

import importlib
import random
from typing import Protocol

from drivers.reading import Action, Observation
from middleware.errors import UnknownTask
from middleware.tasks import Task

KINDS = {
    "find-target": "agents.search:SearchAndApproach",
    "turn-around": "agents.turn:TurnAround",
}
STAND = {"base.vx": 0.0, "base.vy": 0.0, "base.wz": 0.0}


class Behaviour(Protocol):
    """One body at one task."""

    def look(self, seen: Observation, now: float) -> None:
        """Take in what the body senses now."""

    @property
    def cost(self) -> float | None:
        """What doing the task would cost this body (metres, for a distance); None while it cannot tell."""

    def search(self, now: float) -> Action:
        """What to do to be able to tell."""

    def hold(self, now: float) -> Action:
        """What to do while another acts."""

    def execute(self, now: float) -> Action | None:
        """What to do next to get it done; None when it is done."""


def behaviour_for(task: Task, rng: random.Random) -> Behaviour:
    """The behaviour for ``task.kind``: a known kind, or ``module:Class``; raises ``UnknownTask``, which names those there are."""
    target = KINDS.get(task.kind, task.kind if ":" in task.kind else None)
    if target is None:
        raise UnknownTask(f"no behaviour for a task of kind {task.kind!r}; there are {', '.join(sorted(KINDS))}")
    module, _, attribute = target.partition(":")
    try:
        made: Behaviour = getattr(importlib.import_module(module), attribute)(task.parameters, rng)
    except (ImportError, AttributeError) as error:
        raise UnknownTask(f"the behaviour for {task.kind!r} cannot be loaded: {error}") from error
    return made
