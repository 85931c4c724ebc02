"""Nodes of one process in virtual time: clock, switchboard, the nodes' lives, and state that survives a node.

``World`` is the base of every simulated team; ``Fleet`` has nodes of the library, ``SwarmFleet`` whole device nodes.
A team with a scenario is ``sim.team.team.Team``.
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
from middleware.entangled.network.switchboard import CALM, Switchboard, SwitchboardNetwork, Traffic, Weather
from middleware.entangled.node import EntangledNode
from middleware.node import SwarmNode
from sim.team.event import Born, Died
from sim.team.history import History

TEAM = b"t" * 32
PORT = 7000
JOINING = 0.3
CAPABILITIES = {"camera": {"width": 208}}

Watcher = Callable[[int, Any], object]
"""Called with a place and its node."""


class World:
    """The clock, the network, the stores and the history, which survive the nodes."""

    def __init__(self, seed: int | str, weather: Weather = CALM) -> None:
        self.seed = seed
        self.clock = HeapClock()
        self.board = Switchboard(self.clock, self.generator("board"), weather)
        self.history = History(self.clock.seconds)
        """The events for the checker: lives of nodes, and clients' requests and answers."""
        self.total_traffic = Traffic()
        """The traffic of all nodes together."""
        self.stores: dict[int, Store] = {}
        self.lives = 0
        self.living: dict[int, Any] = {}
        """The living nodes by place."""
        self.life: Counter[int] = Counter()
        """The number of the present or last life by place."""
        self.on_birth: list[Watcher] = []
        self.on_death: list[Watcher] = []

    def generator(self, name: str) -> random.Random:
        """Return a random generator that depends only on the seed and ``name``."""
        return random.Random(f"{self.seed}/{name}")

    def address(self, place: int) -> Address:
        """Return the address of the node at this place."""
        return Address("10.0.0.1", PORT + place)

    def network(self, place: int) -> SwitchboardNetwork:
        """Return the network port of the node at this place."""
        return self.board.network(*self.address(place), traffic=self.total_traffic)

    def identity(self, place: int) -> Identity:
        """Return the permanent identity of the node at this place."""
        return Identity(self.generator(str(place)).randbytes(32))

    def rng(self, place: int) -> random.Random:
        """Return a random generator that differs from the generators of former lives."""
        self.lives += 1
        return self.generator(f"{place}/{self.lives}")

    def store(self, place: int) -> Store:
        """Return the store of the node at this place, the same in each life."""
        return self.stores.setdefault(place, MemoryStore())

    def run(self, seconds: float) -> None:
        """Let ``seconds`` pass."""
        self.clock.advance(seconds)

    # -- lives ------------------------------------------------------------------------------------------------------

    def alive(self) -> list[int]:
        """Return the places with running nodes, frozen ones included."""
        return sorted(self.living)

    def attend(self, born: Watcher, died: Watcher) -> None:
        """Call ``born`` with every living node and each later one before it starts, and ``died`` at each end."""
        self.on_birth.append(born)
        self.on_death.append(died)
        for place in self.alive():
            born(place, self.living[place])

    def begin_life(self, place: int, node: Any, identity: Identity) -> None:
        """Record that a node of this place starts, and call the watchers."""
        self.living[place] = node
        self.life[place] += 1
        address = str(self.address(place))
        self.history.note(Born, place, self.life[place], identity.public, identity.node_id, address)
        for born in self.on_birth:
            born(place, node)

    def end_life(self, place: int, forgets: bool = False) -> Any:
        """Record that the node of this place ends, and call the watchers; returns the node."""
        node = self.living[place]
        self.history.note(Died, place, forgets)
        for died in self.on_death:
            died(place, node)
        return self.living.pop(place)


class Fleet(World):
    """``n`` nodes of the library that join one after the other through the first."""

    def __init__(self, n: int, seed: int = 1, weather: Weather = CALM) -> None:
        super().__init__(seed, weather)
        self.nodes: list[EntangledNode] = []
        for place in range(n):
            self.restart(place, [0] if place else [])
            self.run(JOINING)

    def made(self, place: int, lease: float = 1.0) -> EntangledNode:
        """Return a node of this place for its next life, not started."""
        network = self.network(place)
        identity, store = self.identity(place), self.store(place)
        return EntangledNode(identity, TEAM, network, store, self.clock, self.rng(place), lease)

    def enter(self, node: EntangledNode, known: Sequence[Address]) -> Deferred[None]:
        """Start a node and let it join."""
        node.start()
        return node.join(known)

    def add(self) -> EntangledNode:
        """Add a node, which joins."""
        node = self.restart(len(self.nodes))
        self.run(JOINING)
        return node

    def memory(self, place: int) -> int:
        """Return the number of the node's store; a new one may lack unacknowledged writes."""
        return 0

    def kill(self, place: int, forgets: bool = False) -> None:
        """Kill a node like a loss of power; its store stays as it is.

        ``forgets``: the next life may lack stored data.
        """
        if place in self.living:
            self.end_life(place, forgets)
        self.nodes[place].vanish()

    def restart(self, place: int, known: Sequence[int] = (0,)) -> EntangledNode:
        """Start the next life of a node with the store of the last one; the first life for a new place."""
        node = self.made(place)
        if place == len(self.nodes):
            self.nodes.append(node)
        else:
            self.nodes[place] = node
        self.begin_life(place, node, node.identity)
        joining = self.enter(node, [self.address(other) for other in known])
        # The node may be killed before it has joined.
        joining.addErrback(lambda failure: failure.trap(NotRunning))
        return node

    def stop(self) -> None:
        """End every node."""
        for node in self.nodes:
            node.stop()


class SwarmFleet(World):
    """``n`` swarm nodes named dog0, dog1 ...; with ``pause`` 0 all of them join at the same time."""

    def __init__(self, n: int, seed: int = 1, weather: Weather = CALM, pause: float = JOINING) -> None:
        super().__init__(seed, weather)
        self.nodes: list[SwarmNode] = []
        for place in range(n):
            self.nodes.append(self.made(place))
            self.nodes[place].startService()
            self.run(pause)

    def made(self, place: int) -> SwarmNode:
        """Return a node of this place, not started."""
        network = self.network(place)
        device = Device("", f"dog{place}", capabilities=CAPABILITIES)
        known = [self.address(0)] if place else []
        identity, store = self.identity(place), self.store(place)
        return SwarmNode(device, identity, TEAM, known, network, store, self.clock, self.rng(place), self.clock.seconds)

    def stop(self) -> None:
        """End every node."""
        for node in self.nodes:
            if node.running:
                node.stopService()
