"""The names with which tasks refer to deployed modules, and the lookup of the modules' factories; pure.

This module does not import ``middleware.deployment``, because nodes that do not allow deployment also have to resolve
these names.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from middleware.errors import SwarmError, UnknownStrategy, UnknownTask

STRATEGY, BEHAVIOUR = "strategy", "behaviour"
KINDS = (STRATEGY, BEHAVIOUR)
PREFIX = "deployed:"
"""Prefix of the name of a deployed module in a task's strategy or kind."""
ERRORS_BY_KIND: Mapping[str, type[SwarmError]] = {STRATEGY: UnknownStrategy, BEHAVIOUR: UnknownTask}

Factory = Callable[..., Any]
"""Creates a strategy (no arguments) or a behaviour (parameters and random generator)."""
DeployedModules = Mapping[tuple[str, str], Factory]
"""The factories of the modules that run on this node, by kind and name without ``PREFIX``."""


def is_deployed(name: str) -> bool:
    """Return whether ``name``, a task's strategy or kind, refers to a deployed module."""
    return name.startswith(PREFIX)


def find_factory(kind: str, name: str, deployed: DeployedModules) -> Factory:
    """Return the factory of the deployed module ``name`` of this ``kind``.

    Raises ``UnknownStrategy`` or ``UnknownTask``, depending on ``kind``; the text of the exception lists the known
    names.
    """
    make = deployed.get((kind, name.removeprefix(PREFIX)))
    if make is None:
        known = ", ".join(sorted(f"{PREFIX}{each}" for other, each in deployed if other == kind)) or "none"
        raise ERRORS_BY_KIND[kind](
            f"{kind} {name!r} is not deployed on this node (see [deployment] in the node's settings); deployed: {known}"
        )
    return make
