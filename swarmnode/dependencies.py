"""The parts of the environment that a node depends on."""

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
    from middleware.admission.membership_file import MembershipStore
    from middleware.deployment.module_channel import Channel
    from middleware.faults.injector import Process


@dataclass(frozen=True)
class Dependencies:
    """The environment of a node: clock, network, store and processes.

    ``network`` creates the node's port each time it joins.  ``connector`` opens links to robots and simulators
    (None: TCP).  ``wall`` returns Unix time.  ``shelf`` stores deployed modules (None: in memory).  ``process`` is
    killed or frozen by an injected fault (None: not possible).  ``lan`` creates the multicast socket for discovery
    (None: no discovery).  ``spawn`` starts the process of a deployed module (None: a confined process on this machine).
    ``membership`` is the node's membership of a closed team (None: the team is open).
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
    membership: MembershipStore | None = None
    spawn: Callable[[], Channel] | None = None
