"""Load a device's agent by the name in its settings (thesis, Table 5.1)."""

from __future__ import annotations

import importlib
import random
from collections.abc import Callable
from typing import Any

from twisted.application.service import Service
from twisted.internet.interfaces import IReactorTime

from drivers.driver import Driver
from middleware.errors import UnknownAgent
from middleware.node import SwarmNode

BUILT_IN = {"search": "agents.loop:Agent"}
AgentFactory = Callable[[SwarmNode, Driver, IReactorTime, random.Random], Service]


def load_agent(name: str) -> AgentFactory:
    """Return the factory of the agent ``name``: a built-in agent, or ``module:Class`` on this machine.

    Raises ``UnknownAgent``, which lists the known names.
    """
    target = BUILT_IN.get(name, name if ":" in name else None)
    if target is None:
        known = ", ".join(sorted(BUILT_IN))
        raise UnknownAgent(f"unknown agent {name!r}; use {known}, or module:Class")
    module, _, attribute = target.partition(":")
    try:
        make: Any = getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError) as error:
        raise UnknownAgent(f"agent {name!r} cannot be loaded: {error}") from error
    return make  # type: ignore[no-any-return]
