"""Run nodes in one process in virtual time: clock, switchboard, starts and ends of nodes, and data that survives.

``Simulation`` is the base of every simulated team; ``EntangledTeam`` has nodes of the library, ``SwarmTeam`` complete
device nodes. A node starts and ends at a *place*, several times if it restarts; each time is a *life*.  A team with a
scenario is ``sim.team.team.Team``.
"""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any

from twisted.internet.defer import Deferred

from middleware.directory.presence import Device
from middleware.entangled.clock import HeapClock
from middleware.entangled.data.memory import MemoryStore
from middleware.entangled.data.store import Store
from middleware.entangled.errors import NotRunning
from middleware.entangled.identity import Identity
from middleware.entangled.network.network import Address
from middleware.entangled.network.switchboard import (
    PERFECT,
    LinkConditions,
    Switchboard,
    SwitchboardNetwork,
    TrafficCounters,
)
from middleware.entangled.node import EntangledNode
from middleware.node import SwarmNode
from sim.team.event import Born, Died
from sim.team.history import History

TEAM_KEY = b"t" * 32
FIRST_PORT = 7000
JOIN_S = 0.3
CAPABILITIES = {"camera": {"width": 208}}

LifeWatcher = Callable[[int, Any], object]
"""Called with a place and the node that starts or ends there."""


class Simulation:
    """The clock, the network, the stores and the history, which survive the nodes."""

    def __init__(self, seed: int | str, conditions: LinkConditions = PERFECT) -> None:
        self.seed = seed
        self.clock = HeapClock()
        self.switchboard = Switchboard(self.clock, self.make_rng("board"), conditions)
        self.history = History(self.clock.seconds)
        """The events for the checker: starts and ends of nodes, and clients' requests and answers."""
        self.total_traffic = TrafficCounters()
        """The traffic of all nodes together."""
        self.stores: dict[int, Store] = {}
        self.life_count = 0
        self.living: dict[int, Any] = {}
        """The living nodes by place."""
        self.life_numbers: Counter[int] = Counter()
        """The number of the current or last life, by place."""
        self.on_birth: list[LifeWatcher] = []
        self.on_death: list[LifeWatcher] = []

    def make_rng(self, name: str) -> random.Random:
        """Return a random generator that depends only on the seed and ``name``."""
        return random.Random(f"{self.seed}/{name}")

    def address(self, place: int) -> Address:
        """Return the address of the node at this place."""
        return Address("10.0.0.1", FIRST_PORT + place)

    def network(self, place: int) -> SwitchboardNetwork:
        """Return the network port of the node at this place."""
        return self.switchboard.make_network(*self.address(place), traffic=self.total_traffic)

    def identity(self, place: int) -> Identity:
        """Return the permanent identity of the node at this place."""
        return Identity(self.make_rng(str(place)).randbytes(32))

    def make_life_rng(self, place: int) -> random.Random:
        """Return a random generator for the next life of a place, different from those of earlier lives."""
        self.life_count += 1
        return self.make_rng(f"{place}/{self.life_count}")

    def store(self, place: int) -> Store:
        """Return the store of the node at this place, the same in each life."""
        return self.stores.setdefault(place, MemoryStore())

    def run(self, seconds: float) -> None:
        """Let ``seconds`` pass."""
        self.clock.advance(seconds)

    # -- lives ------------------------------------------------------------------------------------------------------

    def alive(self) -> list[int]:
        """Return the places with running nodes, including frozen nodes."""
        return sorted(self.living)

    def watch_lives(self, born: LifeWatcher, died: LifeWatcher) -> None:
        """Call ``born`` for all running nodes and for each later node before it starts, and ``died`` at each end."""
        self.on_birth.append(born)
        self.on_death.append(died)
        for place in self.alive():
            born(place, self.living[place])

    def begin_life(self, place: int, node: Any, identity: Identity) -> None:
        """Record that a node of this place starts, and call the watchers."""
        self.living[place] = node
        self.life_numbers[place] += 1
        address = str(self.address(place))
        self.history.record(Born, place, self.life_numbers[place], identity.public, identity.node_id, address)
        for born in self.on_birth:
            born(place, node)

    def end_life(self, place: int, forgets: bool = False) -> Any:
        """Record that the node of this place ends, and call the watchers; returns the node."""
        node = self.living[place]
        self.history.record(Died, place, forgets)
        for died in self.on_death:
            died(place, node)
        return self.living.pop(place)


class EntangledTeam(Simulation):
    """``n`` nodes of the library that join one after the other through the first."""

    def __init__(self, n: int, seed: int = 1, conditions: LinkConditions = PERFECT) -> None:
        super().__init__(seed, conditions)
        self.nodes: list[EntangledNode] = []
        for place in range(n):
            self.restart(place, [0] if place else [])
            self.run(JOIN_S)

    def make_node(self, place: int, lease: float = 1.0) -> EntangledNode:
        """Return a node for the next life of this place, not started."""
        network = self.network(place)
        identity, store = self.identity(place), self.store(place)
        return EntangledNode(identity, TEAM_KEY, network, store, self.clock, self.make_life_rng(place), lease)

    def start_node(self, node: EntangledNode, known: Sequence[Address]) -> Deferred[None]:
        """Start a node and let it join."""
        node.start()
        return node.join(known)

    def add(self) -> EntangledNode:
        """Add a node, which joins."""
        node = self.restart(len(self.nodes))
        self.run(JOIN_S)
        return node

    def get_store_number(self, place: int) -> int:
        """Return the number of the node's store; a store with a new number may lack unacknowledged writes."""
        return 0

    def kill(self, place: int, forgets: bool = False) -> None:
        """Kill a node as by a loss of power; its store does not change.

        With ``forgets``, the next life may lack stored data.
        """
        if place in self.living:
            self.end_life(place, forgets)
        self.nodes[place].stop_silently()

    def restart(self, place: int, known: Sequence[int] = (0,)) -> EntangledNode:
        """Start the next node at a place, with the store of the last one; at a new place, start the first node."""
        node = self.make_node(place)
        if place == len(self.nodes):
            self.nodes.append(node)
        else:
            self.nodes[place] = node
        self.begin_life(place, node, node.identity)
        joining = self.start_node(node, [self.address(other) for other in known])
        # The node may be killed before it has joined.
        joining.addErrback(lambda failure: failure.trap(NotRunning))
        return node

    def stop(self) -> None:
        """End every node."""
        for node in self.nodes:
            node.stop()


class SwarmTeam(Simulation):
    """``n`` swarm nodes named dog0, dog1 ...; with ``pause`` 0 all of them join at the same time."""

    def __init__(self, n: int, seed: int = 1, conditions: LinkConditions = PERFECT, pause: float = JOIN_S) -> None:
        super().__init__(seed, conditions)
        self.nodes: list[SwarmNode] = []
        for place in range(n):
            self.nodes.append(self.make_node(place))
            self.nodes[place].startService()
            self.run(pause)

    def make_node(self, place: int) -> SwarmNode:
        """Return a node of this place, not started."""
        network = self.network(place)
        device = Device("", f"dog{place}", capabilities=CAPABILITIES)
        known = [self.address(0)] if place else []
        identity, store = self.identity(place), self.store(place)
        return SwarmNode(
            device, identity, TEAM_KEY, known, network, store, self.clock, self.make_life_rng(place), self.clock.seconds
        )

    def stop(self) -> None:
        """End every node."""
        for node in self.nodes:
            if node.running:
                node.stopService()
