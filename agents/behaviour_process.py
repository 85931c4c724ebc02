"""Convert observations, motion capabilities and contexts to plain values, and serve deployed behaviours; pure."""

from __future__ import annotations

import random
from collections.abc import Mapping
from dataclasses import astuple
from typing import Any

from agents.context import Context
from agents.motion import MotionCapabilities
from drivers.reading import Frame, Observation
from middleware.consensus.deployed_modules import Factory

OPTIONAL_ATTRIBUTES: Mapping[str, object] = {
    "is_safe": True,
    "progress": None,
    "valid_for": 0.0,
    "angle": None,
    "value": (),
    "choice": "",
    "weight": 1.0,
    "electorate": 0.0,
}
"""The optional attributes of a behaviour with their defaults (``agents.behaviour``)."""
LOOK, SEARCH, HOLD, EXECUTE, EMBODY = "look", "search", "hold", "execute", "embody"


class BehaviourKind:
    """Serves behaviours in a separate process; each reply contains the result, the cost and the optional attributes."""

    def make(self, make: Factory, arguments: list[Any]) -> object:
        """Create a behaviour from a task's parameters, with its own random generator."""
        parameters, seed = arguments
        return _HostedBehaviour(make(parameters, random.Random(seed)))

    def describe_instance(self, thing: object) -> dict[str, Any]:
        """Return the behaviour's cost and attributes before the first observation."""
        assert isinstance(thing, _HostedBehaviour)
        return {"told": read_attributes(thing.behaviour)}

    def call(self, thing: object, method: str, arguments: list[Any]) -> object:
        """Call one method; return its result, and the cost and attributes after the call."""
        assert isinstance(thing, _HostedBehaviour)
        behaviour = thing.behaviour
        result = None
        if method == EMBODY:
            thing.embody(arguments[0])
        elif method == LOOK:
            behaviour.look(decode_observation(arguments[0]), arguments[1])
        elif method == EXECUTE:
            now, token, deadline, began, is_resumed, value, choice = arguments
            context = Context(now, token, deadline, began, is_resumed, tuple(value), choice)
            result = _encode_action(behaviour.execute(context))
        else:
            result = _encode_action({SEARCH: behaviour.search, HOLD: behaviour.hold}[method](arguments[0]))
        return [result, read_attributes(behaviour)]


class _HostedBehaviour:
    """A behaviour and the motion capabilities of its robot."""

    def __init__(self, behaviour: Any) -> None:
        self.behaviour = behaviour
        self._motion: MotionCapabilities | None = None

    def embody(self, fields: dict[str, Any]) -> None:
        """Pass on the motion capabilities; later calls update the same object."""
        is_new = self._motion is None
        self._motion = motion = self._motion or MotionCapabilities()
        for name, value in fields.items():
            setattr(motion, name, _tuples_from_lists(value))
        if is_new and hasattr(self.behaviour, "embody"):
            self.behaviour.embody(motion)


def read_attributes(thing: object) -> list[Any]:
    """Return the cost and the optional attributes of a behaviour, in the order of ``OPTIONAL_ATTRIBUTES``."""
    return [
        getattr(thing, "cost", None),
        *(getattr(thing, name, default) for name, default in OPTIONAL_ATTRIBUTES.items()),
    ]


def encode_motion(motion: MotionCapabilities) -> dict[str, Any]:
    """Convert motion capabilities to plain values, without ``run``, because the process decodes pictures itself."""
    fields = {name: value for name, value in vars(motion).items() if name != "run"}
    return {name: dict(value) if isinstance(value, Mapping) else value for name, value in fields.items()}


def encode_observation(seen: Observation) -> list[Any]:
    """Convert an observation to plain values."""
    samples = {key: list(values) for key, values in seen.samples.items()}
    frame = None if seen.frame is None else list(astuple(seen.frame))
    return [seen.t_host, seen.t_robot, dict(seen.values), samples, frame]


def decode_observation(fields: list[Any]) -> Observation:
    """Rebuild an observation from plain values."""
    t_host, t_robot, values, samples, frame = fields
    sample_tuples = {key: tuple(each) for key, each in samples.items()}
    return Observation(t_host, t_robot, values, sample_tuples, None if frame is None else Frame(*frame))


def _tuples_from_lists(value: object) -> object:
    if isinstance(value, dict):
        return {key: _tuples_from_lists(each) for key, each in value.items()}
    return tuple(value) if isinstance(value, list) else value


def _encode_action(action: object) -> dict[str, float] | None:
    if action is None:
        return None
    if not isinstance(action, Mapping):
        raise TypeError(f"an action must be a mapping, not {type(action).__name__}")
    return {str(key): float(value) for key, value in action.items()}
