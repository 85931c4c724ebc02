"""Deployed: how a task names a module that an operator pushed, and what makes the thing it names; pure.

Every node looks such names up, also one that allows no deployment and so loads nothing of ``middleware.deployment``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from middleware.errors import SwarmError, UnknownStrategy, UnknownTask

STRATEGY, BEHAVIOUR = "strategy", "behaviour"
KINDS = (STRATEGY, BEHAVIOUR)
PREFIX = "deployed:"
"""Before the name of a module where a task names it as its strategy or its kind."""
ERRORS: Mapping[str, type[SwarmError]] = {STRATEGY: UnknownStrategy, BEHAVIOUR: UnknownTask}

Make = Callable[..., Any]
"""What makes a strategy (no arguments) or the way to a behaviour (parameters and random generator)."""
Deployed = Mapping[tuple[str, str], Make]
"""(kind, name without ``PREFIX``) to what makes it: the modules that run on one node."""


def is_deployed(name: str) -> bool:
    """Whether a task's strategy or kind is a module that an operator pushed."""
    return name.startswith(PREFIX)


def maker_of(kind: str, name: str, deployed: Deployed) -> Make:
    """What makes the module of this ``kind`` that a task calls ``name``.

    Raises ``UnknownStrategy`` or ``UnknownTask``, as the kind is; it names those that there are.
    """
    make = deployed.get((kind, name.removeprefix(PREFIX)))
    if make is None:
        known = ", ".join(sorted(f"{PREFIX}{each}" for other, each in deployed if other == kind)) or "none"
        raise ERRORS[kind](f"no {kind} {name!r} here ([deployment] of this node); there are {known}")
    return make
