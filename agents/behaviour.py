"""The interface of behaviours: pure code that performs one kind of task with one robot, loaded by name.

A behaviour receives observations and returns actions (``drivers.reading``).  It has no access to peers or leases: the
agent decides whether the behaviour may act.
"""

from __future__ import annotations

import importlib
import random
from typing import Protocol

from agents.context import Context
from agents.motion import STAND as STAND
from agents.motion import MotionCapabilities
from drivers.reading import Action, Observation
from middleware.consensus.deployed_modules import BEHAVIOUR, DeployedModules, find_factory, is_deployed
from middleware.errors import MissingExtra, UnknownTask
from middleware.tasks.task import Task

KINDS = {
    "find-target": "agents.search:SearchAndApproach",
    "turn-around": "agents.turn_around:TurnAround",
    "watch-target": "agents.watch_target:WatchTarget",
}
ENTRY_POINT_GROUP = "swarm_node.behaviours"
VISION_MODULES = ("cv2", "numpy")


class Behaviour(Protocol):
    """One robot's execution of one task.

    The constructor gets the task's parameters and a random generator, and raises ``ValueError`` for invalid parameters.
    A behaviour may also have these attributes:

    - ``is_safe``: whether the task may be reassigned now; default True
    - ``progress``: the share of the task that is done, 0 to 1
    - ``valid_for``: seconds for which the cost is valid; default: as long as the node is present
    - ``angle`` and ``take_post``: see ``agents.formation``
    - ``embody``: a method that gets the robot's motion capabilities before the first ``look``, see ``agents.motion``
    - ``close``: a method that is called after the agent has left the task

    Some strategies also read ``value`` (a tuple: one number, or a position in metres), ``choice`` (the option for
    which the agent votes), ``weight`` (the weight of the value or the vote) and ``electorate`` (the total weight of
    all agents that may vote).
    """

    def look(self, seen: Observation, now: float) -> None:
        """Process an observation of the robot's sensors; ``now`` is in seconds."""

    @property
    def cost(self) -> float | None:
        """The cost of the task for this robot, at least 0; a distance is in metres.  None while the cost is unknown."""

    def search(self, now: float) -> Action:
        """Return the next action while the cost is unknown and the agent holds no lease."""

    def hold(self, now: float) -> Action:
        """Return the next action while the cost is known and the agent holds no lease."""

    def execute(self, context: Context) -> Action | None:
        """Return the next action of the task; None if the task is done."""


def create_behaviour(
    task: Task, rng: random.Random, deployed: DeployedModules | None = None, motion: MotionCapabilities | None = None
) -> Behaviour:
    """Create the behaviour for ``task.kind``: a built-in one, or an entry point of ``swarm_node.behaviours``.

    The kind ``deployed:x`` selects the module ``x`` of ``deployed``, the modules that an operator deployed to the
    team. If ``motion`` is given, it is passed to the behaviour's ``embody``.

    A task comes from the network, so its kind only selects an installed or deployed behaviour and is never an import
    path.  Raises ``UnknownTask`` if the kind is unknown or the parameters are invalid, and ``MissingExtra`` if the
    behaviour's libraries are not installed.
    """
    behaviour = _create_deployed(task, rng, deployed or {}) if is_deployed(task.kind) else _create_installed(task, rng)
    embody = getattr(behaviour, "embody", None)
    if motion is not None and embody is not None:
        embody(motion)
    return behaviour


def _create_installed(task: Task, rng: random.Random) -> Behaviour:
    target = KINDS.get(task.kind)
    if target is None:
        from importlib.metadata import entry_points  # slow to import, and rarely needed

        found = {point.name: point.value for point in entry_points(group=ENTRY_POINT_GROUP)}
        target = found.get(task.kind)
        if target is None:
            known = ", ".join(sorted(KINDS | found))
            raise UnknownTask(f"no behaviour for tasks of kind {task.kind!r}; known kinds: {known}")
    module, _, attribute = target.partition(":")
    try:
        factory = getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError) as error:
        if (getattr(error, "name", None) or "").split(".")[0] in VISION_MODULES:
            raise MissingExtra(f"the behaviour for {task.kind!r}", "vision") from error
        raise UnknownTask(f"the behaviour for {task.kind!r} cannot be loaded: {error}") from error
    try:
        behaviour: Behaviour = factory(task.parameters, rng)
    except (TypeError, ValueError, AttributeError, LookupError) as error:
        raise UnknownTask(f"invalid parameters of a task of kind {task.kind!r}: {error}") from error
    return behaviour


def _create_deployed(task: Task, rng: random.Random, deployed: DeployedModules) -> Behaviour:
    from agents.behaviour_proxy import BehaviourProxy  # rarely needed

    return BehaviourProxy(find_factory(BEHAVIOUR, task.kind, deployed)(task.parameters, rng), STAND)
