"""Behaviour: how a body does one kind of task; pure, and loaded by name.

A behaviour sees observations and names actions.  It knows neither peers nor leases: whether it may act is decided
outside.
"""

from __future__ import annotations

import importlib
import random
from typing import Protocol

from agents.context import Context
from agents.means import STAND as STAND
from agents.means import Means
from drivers.reading import Action, Observation
from middleware.consensus.deployed import BEHAVIOUR, Deployed, is_deployed, maker_of
from middleware.errors import MissingExtra, UnknownTask
from middleware.tasks.task import Task

KINDS = {
    "find-target": "agents.search:SearchAndApproach",
    "turn-around": "agents.turn:TurnAround",
    "watch-target": "agents.watch:WatchTarget",
}
ENTRY_POINTS = "swarm_node.behaviours"
VISION = ("cv2", "numpy")


class Behaviour(Protocol):
    """One body at one task.

    A behaviour may also have: ``is_safe``, whether the task may change hands now (usually it always may);
    ``progress``, the share that is done, 0 to 1; ``valid_for``, the seconds for which its cost counts (usually as long
    as its node lives); ``angle`` and ``take_post``, see ``agents.formation``; ``embody``, which is given what the
    body can do before the first look, see ``agents.means``; ``close``, called when its agent has left the task.  For
    strategies that go by it: ``value``, the number or the place that it has to offer (a tuple; metres), ``choice``, the
    option that it is for, the ``weight`` of both, and
    ``electorate``, the weight of all that may vote.
    """

    def look(self, seen: Observation, now: float) -> None:
        """Take in what the body senses now."""

    @property
    def cost(self) -> float | None:
        """What doing the task would cost this body (metres, for a distance); None while it cannot tell."""

    def search(self, now: float) -> Action:
        """What to do to be able to tell."""

    def hold(self, now: float) -> Action:
        """What to do while another acts."""

    def execute(self, context: Context) -> Action | None:
        """What to do next to get it done; None when it is done."""


def behaviour_for(
    task: Task, rng: random.Random, deployed: Deployed | None = None, means: Means | None = None
) -> Behaviour:
    """The behaviour for ``task.kind``: a built-in one, or an entry point of ``swarm_node.behaviours``.

    ``deployed:x`` is the module ``x`` that an operator pushed, among those in ``deployed``.  Where there are ``means``
    the behaviour is told what its body can do.

    A task comes from the wire, so its kind is looked up among what is installed here and never imported as it stands.
    Raises ``UnknownTask``, which names those there are or says what is wrong with the task's parameters, and
    ``MissingExtra`` where the behaviour's libraries are not installed.
    """
    made = _deployed(task, rng, deployed or {}) if is_deployed(task.kind) else _installed(task, rng)
    embody = getattr(made, "embody", None)
    if means is not None and embody is not None:
        embody(means)
    return made


def _installed(task: Task, rng: random.Random) -> Behaviour:
    target = KINDS.get(task.kind)
    if target is None:
        from importlib.metadata import entry_points  # heavy, and most nodes never come here

        found = {point.name: point.value for point in entry_points(group=ENTRY_POINTS)}
        target = found.get(task.kind)
        if target is None:
            known = ", ".join(sorted(KINDS | found))
            raise UnknownTask(f"no behaviour for a task of kind {task.kind!r}; there are {known}")
    module, _, attribute = target.partition(":")
    try:
        make = getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError) as error:
        if (getattr(error, "name", None) or "").split(".")[0] in VISION:
            raise MissingExtra(f"the behaviour for {task.kind!r}", "vision") from error
        raise UnknownTask(f"the behaviour for {task.kind!r} cannot be loaded: {error}") from error
    try:
        made: Behaviour = make(task.parameters, rng)
    except (TypeError, ValueError, AttributeError, LookupError) as error:
        raise UnknownTask(f"a task of kind {task.kind!r} cannot have these parameters: {error}") from error
    return made


def _deployed(task: Task, rng: random.Random, deployed: Deployed) -> Behaviour:
    from agents.guarded import Guarded  # most nodes never come here

    return Guarded(maker_of(BEHAVIOUR, task.kind, deployed)(task.parameters, rng), STAND)
