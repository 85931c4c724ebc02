"""Seams: where a node touches the world."""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from twisted.internet.interfaces import IReactorTime

from middleware.entangled.data.store import Store
from middleware.entangled.network.network import Network


@dataclass(frozen=True)
class Seams:
    """Where a node touches the world; everything else is logic.

    ``network`` makes the node's port each time that it enters the network; ``connector`` opens links to robots and
    yards (None: TCP); ``wall`` is unix time, for people; ``shelf`` is where deployed modules are kept (None: they are
    forgotten when the node ends).
    """

    clock: IReactorTime
    network: Callable[[], Network]
    store: Store
    rng: random.Random
    wall: Callable[[], float]
    connector: Any = None
    shelf: Any = None
