"""Nodes of one process in virtual time: a clock, a switchboard, and the stores that outlive a node.

``World`` is what every simulated team has; ``Fleet`` has peers of the library, ``SwarmFleet`` whole nodes.  A team with
a scenario of its own is ``sim.team.team.Team``.
"""

from __future__ import annotations

import random
from collections.abc import Sequence

from twisted.internet.defer import Deferred

from middleware.directory.presence import Device
from middleware.entangled.clock import HeapClock
from middleware.entangled.data.memory import MemoryStore
from middleware.entangled.data.store import Store
from middleware.entangled.identity import Identity
from middleware.entangled.network.network import Address
from middleware.entangled.network.switchboard import CALM, Switchboard, SwitchboardNetwork, Traffic, Weather
from middleware.entangled.node import EntangledNode
from middleware.node import SwarmNode

TEAM = b"t" * 32
JOINING = 0.3


class World:
    """The clock, the wire and the stores; what ends on one node's death lives on here."""

    def __init__(self, seed: int, weather: Weather = CALM) -> None:
        self.seed = seed
        self.clock = HeapClock()
        self.board = Switchboard(self.clock, random.Random(f"{seed}/board"), weather)
        self.total_traffic = Traffic()
        """What all nodes together have sent and received."""
        self.stores: dict[int, Store] = {}
        self.lives = 0

    def address(self, place: int) -> Address:
        """Where the node of this place listens."""
        return Address("10.0.0.1", 7000 + place)

    def network(self, place: int) -> SwitchboardNetwork:
        """The port of the node of this place."""
        return self.board.network(*self.address(place), traffic=self.total_traffic)

    def identity(self, place: int) -> Identity:
        """The lasting identity of the node of this place."""
        return Identity(random.Random(f"{self.seed}/{place}").randbytes(32))

    def rng(self, place: int) -> random.Random:
        """Dice that never fall as those of a former life."""
        self.lives += 1
        return random.Random(f"{self.seed}/{place}/{self.lives}")

    def store(self, place: int) -> Store:
        """The store of the node of this place, the same in each of its lives."""
        return self.stores.setdefault(place, MemoryStore())

    def run(self, seconds: float) -> None:
        """Let time pass."""
        self.clock.advance(seconds)


class Fleet(World):
    """``n`` entangled nodes that join one after the other through the first."""

    def __init__(self, n: int, seed: int = 1, weather: Weather = CALM) -> None:
        super().__init__(seed, weather)
        self.nodes: list[EntangledNode] = []
        for place in range(n):
            self.nodes.append(self.made(place))
            self.enter(self.nodes[place], [self.address(0)] if place else [])
            self.run(JOINING)

    def made(self, place: int, lease: float = 1.0) -> EntangledNode:
        """A node of this place, not started; the next life of one that was there before."""
        network = self.network(place)
        identity, store = self.identity(place), self.store(place)
        return EntangledNode(identity, TEAM, network, store, self.clock, self.rng(place), lease)

    def enter(self, node: EntangledNode, known: Sequence[Address]) -> Deferred[None]:
        """Start a node and let it join."""
        node.start()
        return node.join(known)

    def add(self) -> EntangledNode:
        """One more node, which joins."""
        self.nodes.append(self.made(len(self.nodes)))
        self.enter(self.nodes[-1], [self.address(0)])
        self.run(JOINING)
        return self.nodes[-1]

    def memory(self, place: int) -> int:
        """Which memory the node of a place has; another one may lack what was not acknowledged."""
        return 0

    def forgets(self, place: int) -> bool:
        """Whether the next life of a node that is killed now may lack what this one has stored."""
        return False

    def kill(self, place: int) -> None:
        """End a node as a loss of power does; its store is left as it is."""
        self.nodes[place].vanish()

    def restart(self, place: int, known: Sequence[int] = (0,)) -> EntangledNode:
        """The next life of a node that has ended, on the store of the last one."""
        self.nodes[place] = self.made(place)
        self.enter(self.nodes[place], [self.address(other) for other in known])
        return self.nodes[place]

    def stop(self) -> None:
        """End every node."""
        for node in self.nodes:
            node.stop()


class SwarmFleet(World):
    """``n`` swarm nodes named dog0, dog1 ...; with ``pause`` 0 all of them join at the same moment."""

    def __init__(self, n: int, seed: int = 1, weather: Weather = CALM, pause: float = JOINING) -> None:
        super().__init__(seed, weather)
        self.nodes: list[SwarmNode] = []
        for place in range(n):
            self.nodes.append(self.made(place))
            self.nodes[place].startService()
            self.run(pause)

    def made(self, place: int) -> SwarmNode:
        """A node of this place, not started."""
        network = self.network(place)
        device = Device("", f"dog{place}", capabilities={"camera": {"width": 208}})
        known = [self.address(0)] if place else []
        identity, store = self.identity(place), self.store(place)
        return SwarmNode(device, identity, TEAM, known, network, store, self.clock, self.rng(place), self.clock.seconds)

    def stop(self) -> None:
        """End every node."""
        for node in self.nodes:
            if node.running:
                node.stopService()
