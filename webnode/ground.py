"""Ground: what the front door has, from which the parts of the board are made."""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from middleware.config.settings import Settings
from middleware.frontend.client import TeamClient
from middleware.node import SwarmNode
from webnode.team import TeamDesk


@dataclass(frozen=True)
class Ground:
    """One web node: ``wall`` is unix time in seconds, ``rng`` the dice of the machine."""

    settings: Settings
    node: SwarmNode
    client: TeamClient
    desk: TeamDesk
    reactor: Any
    wall: Callable[[], float]
    rng: random.Random
