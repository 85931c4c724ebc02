"""Nodes of one process in virtual time: a clock, a switchboard, the lives of the nodes, and what outlives a node.

``World`` is what every simulated team has; ``Fleet`` has peers of the library, ``SwarmFleet`` whole nodes.  A team with
a scenario of its own is ``sim.team.team.Team``.
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
    """The clock, the network, the stores and the history; what ends on one node's death lives on here."""

    def __init__(self, seed: int | str, weather: Weather = CALM) -> None:
        self.seed = seed
        self.clock = HeapClock()
        self.board = Switchboard(self.clock, self.generator("board"), weather)
        self.history = History(self.clock.seconds)
        """What happened, for the checker: who lived, and what clients asked for and were told."""
        self.total_traffic = Traffic()
        """What all nodes together have sent and received."""
        self.stores: dict[int, Store] = {}
        self.lives = 0
        self.living: dict[int, Any] = {}
        """By place, the nodes that live."""
        self.life: Counter[int] = Counter()
        """By place, the number of the present or last life."""
        self.on_birth: list[Watcher] = []
        self.on_death: list[Watcher] = []

    def generator(self, name: str) -> random.Random:
        """A random generator of that name, whose numbers follow from the seed alone."""
        return random.Random(f"{self.seed}/{name}")

    def address(self, place: int) -> Address:
        """Where the node of this place listens."""
        return Address("10.0.0.1", PORT + place)

    def network(self, place: int) -> SwitchboardNetwork:
        """The port of the node of this place."""
        return self.board.network(*self.address(place), traffic=self.total_traffic)

    def identity(self, place: int) -> Identity:
        """The lasting identity of the node of this place."""
        return Identity(self.generator(str(place)).randbytes(32))

    def rng(self, place: int) -> random.Random:
        """Dice that never fall as those of a former life."""
        self.lives += 1
        return self.generator(f"{place}/{self.lives}")

    def store(self, place: int) -> Store:
        """The store of the node of this place, the same in each of its lives."""
        return self.stores.setdefault(place, MemoryStore())

    def run(self, seconds: float) -> None:
        """Let time pass."""
        self.clock.advance(seconds)

    # -- lives ------------------------------------------------------------------------------------------------------

    def alive(self) -> list[int]:
        """The places whose nodes run, those included that stand still."""
        return sorted(self.living)

    def attend(self, born: Watcher, died: Watcher) -> None:
        """Call ``born`` with every node that lives, and with each that is made later before it starts, and ``died``."""
        self.on_birth.append(born)
        self.on_death.append(died)
        for place in self.alive():
            born(place, self.living[place])

    def begin_life(self, place: int, node: Any, identity: Identity) -> None:
        """Write down that a node of this place is about to start, and tell the watchers."""
        self.living[place] = node
        self.life[place] += 1
        address = str(self.address(place))
        self.history.note(Born, place, self.life[place], identity.public, identity.node_id, address)
        for born in self.on_birth:
            born(place, node)

    def end_life(self, place: int, forgets: bool = False) -> Any:
        """Write down that the node of this place ends, and tell the watchers; returns the node."""
        node = self.living[place]
        self.history.note(Died, place, forgets)
        for died in self.on_death:
            died(place, node)
        return self.living.pop(place)


class Fleet(World):
    """``n`` entangled nodes that join one after the other through the first."""

    def __init__(self, n: int, seed: int = 1, weather: Weather = CALM) -> None:
        super().__init__(seed, weather)
        self.nodes: list[EntangledNode] = []
        for place in range(n):
            self.restart(place, [0] if place else [])
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
        node = self.restart(len(self.nodes))
        self.run(JOINING)
        return node

    def memory(self, place: int) -> int:
        """Which memory the node of a place has; another one may lack what was not acknowledged."""
        return 0

    def kill(self, place: int, forgets: bool = False) -> None:
        """End a node as a loss of power does; its store is left as it is.

        ``forgets``: the next life may lack what this one has stored.
        """
        if place in self.living:
            self.end_life(place, forgets)
        self.nodes[place].vanish()

    def restart(self, place: int, known: Sequence[int] = (0,)) -> EntangledNode:
        """The next life of a node, on the store of the last one; the first life, where the place is a new one."""
        node = self.made(place)
        if place == len(self.nodes):
            self.nodes.append(node)
        else:
            self.nodes[place] = node
        self.begin_life(place, node, node.identity)
        joining = self.enter(node, [self.address(other) for other in known])
        # It may be killed before it has found anybody.
        joining.addErrback(lambda failure: failure.trap(NotRunning))
        return node

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
        device = Device("", f"dog{place}", capabilities=CAPABILITIES)
        known = [self.address(0)] if place else []
        identity, store = self.identity(place), self.store(place)
        return SwarmNode(device, identity, TEAM, known, network, store, self.clock, self.rng(place), self.clock.seconds)

    def stop(self) -> None:
        """End every node."""
        for node in self.nodes:
            if node.running:
                node.stopService()
