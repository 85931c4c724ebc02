"""Seams: where a node touches the world."""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from twisted.internet.interfaces import IReactorTime

from middleware.entangled.data.store import Store
from middleware.entangled.network.multicast import Multicast
from middleware.entangled.network.network import Network

if TYPE_CHECKING:
    from middleware.admission.membership import Kept
    from middleware.deployment.frame import Channel
    from middleware.faults.injector import Process


@dataclass(frozen=True)
class Seams:
    """Where a node touches the world; everything else is logic.

    ``network`` makes the node's port each time that it enters the network; ``connector`` opens links to robots and
    yards (None: TCP); ``wall`` is unix time, for people; ``shelf`` is where deployed modules are kept (None: they are
    forgotten when the node ends); ``process`` is what an injected fault kills or freezes (None: neither);
    ``lan`` makes its place in the group of the LAN (None: it does not look there).
    ``spawn`` starts the process of a deployed module (None: a process of this machine, confined).
    ``membership`` is the node's place in a closed team (None: the team is open).
    """

    clock: IReactorTime
    network: Callable[[], Network]
    store: Store
    rng: random.Random
    wall: Callable[[], float]
    connector: Any = None
    shelf: Any = None
    process: Process | None = None
    lan: Callable[[], Multicast] | None = None
    membership: Kept | None = None
    spawn: Callable[[], Channel] | None = None
