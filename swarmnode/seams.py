"""Seams: where a node touches the world."""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

from twisted.internet.interfaces import IReactorTime

from middleware.entangled.data.store import Store
from middleware.entangled.network.network import Network


class Plug(Protocol):
    """How the machine below a node is made to fail."""

    def kill(self) -> None:
        """End the node as a power cut would."""

    def freeze(self, seconds: float) -> None:
        """Let it stand still for so long, and then go on."""


@dataclass(frozen=True)
class Seams:
    """Where a node touches the world; everything else is logic.

    ``network`` makes the node's port each time that it enters the network; ``connector`` opens links to robots and
    yards (None: TCP); ``wall`` is unix time, for people; ``shelf`` is where deployed modules are kept (None: they are
    forgotten when the node ends); ``plug`` is what a fault on purpose pulls (None: neither killed nor frozen).
    """

    clock: IReactorTime
    network: Callable[[], Network]
    store: Store
    rng: random.Random
    wall: Callable[[], float]
    connector: Any = None
    shelf: Any = None
    plug: Plug | None = None
