"""A simulated team: numbered places at which nodes run, with one virtual clock and one switchboard.

The nodes are production code; only clock, network, store and random generators are simulated. Everything follows from
the scenario and the seed, so ``digest`` is the same on every machine.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from twisted.internet.defer import Deferred
from twisted.internet.interfaces import IDelayedCall, IReactorTime
from twisted.logger import Logger

from middleware.directory.presence import Device
from middleware.entangled.errors import NotRunning
from middleware.entangled.identity import Identity
from middleware.entangled.network.nat_router import NatRouter
from middleware.entangled.network.network import Address, Network
from middleware.entangled.network.switchboard import TrafficCounters
from middleware.entangled.node import EntangledNode
from middleware.node import SwarmNode
from sim.team.disk import SimulatedDisk, SurvivingMemory, restore_store
from sim.team.link import TeamLink
from sim.team.machine import Machine, MachineNetwork
from sim.team.scenario import Scenario
from sim.team.simulation import CAPABILITIES, FIRST_PORT, TEAM_KEY, Simulation

Node = EntangledNode | SwarmNode
EventListener = Callable[[float, str, int, str], object]
"""Called with the time, the event, its place (-1: none), and details."""


def get_entangled(node: Node) -> EntangledNode:
    """Return the library's node that ``node`` is or contains."""
    return node.entangled if isinstance(node, SwarmNode) else node


class PlaceState:
    """The state of a place that survives its nodes; ``wall_error`` is the error of its wall clock in seconds."""

    __slots__ = ("address", "identity", "store", "traffic", "wall_error", "rate", "nat", "machine", "join_waiters")

    def __init__(self, address: Address, identity: Identity, store: SurvivingMemory) -> None:
        self.address = address
        self.identity = identity
        self.store = store
        self.traffic = TrafficCounters()
        self.wall_error = 0.0
        self.rate = 1.0
        self.nat: NatRouter | None = None
        self.machine: Machine | None = None
        self.join_waiters: list[Deferred[bool]] | None = None
        """Deferreds that fire when the node has joined; None if it has already joined."""


class Team(Simulation):
    """The team of a ``scenario``; no node exists before ``form`` or ``start_all``."""

    seed: int
    living: dict[int, Node]
    _log = Logger()

    def __init__(self, scenario: Scenario, seed: int = 1) -> None:
        super().__init__(seed)
        self.scenario = scenario
        self.link = TeamLink(scenario.link, f"{seed}/spots")
        self.switchboard.link_model = self.link
        self.event_listeners: list[EventListener] = []
        self._places: list[PlaceState] = []
        self._rng = self.make_rng("team")
        self._joined: list[int] = []
        self._joined_index: dict[int, int] = {}
        self._hash = hashlib.blake2b(digest_size=32)
        for _ in range(scenario.nodes):
            self._new_place()

    # -- members ----------------------------------------------------------------------------------------------------

    @property
    def places(self) -> range:
        """All places, including places without a running node."""
        return range(len(self._places))

    def get_joined(self) -> list[int]:
        """Return the places whose nodes have joined, in arbitrary order; the caller must not modify the result."""
        return self._joined

    def address(self, place: int) -> Address:
        """Return the address of the node at a place."""
        return self._places[place].address

    def node(self, place: int) -> Node:
        """Return the running node at a place; raise ``KeyError`` if no node runs there."""
        return self.living[place]

    def get_entangled(self, place: int) -> EntangledNode:
        """Return the library's node at a place."""
        return get_entangled(self.living[place])

    def identity(self, place: int) -> Identity:
        """Return the identity of the node at a place."""
        return self._places[place].identity

    def traffic(self, place: int) -> TrafficCounters:
        """Return the total traffic of all nodes that ran at a place."""
        return self._places[place].traffic

    def get_state(self, place: int) -> PlaceState:
        """Return the state of a place that survives its nodes."""
        return self._places[place]

    def when_joined(self, place: int) -> Deferred[bool]:
        """Fire with True when the node at a place has joined, or with False if the node ends before it has joined."""
        done: Deferred[bool] = Deferred()
        waiting = self._places[place].join_waiters
        if place not in self.living:
            done.callback(False)
        elif waiting is None:
            done.callback(True)
        else:
            waiting.append(done)
        return done

    # -- time -------------------------------------------------------------------------------------------------------

    def schedule(self, seconds: float, call: Callable[[], object]) -> IDelayedCall:
        """Schedule a call after ``seconds``."""
        return self.clock.callLater(seconds, call)

    def report_event(self, event: str, place: int = -1, more: str = "") -> None:
        """Report an event, which becomes part of the digest."""
        now = self.clock.seconds()
        self._hash.update(f"{now!r} {event} {place} {more}\n".encode())
        for told in self.event_listeners:
            told(now, event, place, more)

    def digest(self) -> str:
        """Return the hash of every delivered datagram and every reported event, in hex."""
        whole = self._hash.copy()
        whole.update(self.switchboard.digest().encode())
        return whole.hexdigest()

    # -- joining ----------------------------------------------------------------------------------------------------

    def start_all(self) -> float:
        """Start the nodes according to the scenario; return the seconds until the last node starts."""
        join, moment = self.scenario.join, 0.0
        for place in self.places:
            if place and (
                join.how == "one by one"
                or (join.how == "at once" and place == 1)
                or (join.how == "batches" and (place == 1 or (place - 1) % join.size == 0))
            ):
                moment += join.pause
            self.schedule(moment, partial(self.start, place))
        return moment

    def is_joined(self) -> bool:
        """Return whether every living node has joined."""
        return len(self._joined) == len(self.living)

    def form(self) -> None:
        """Start the nodes and let the team settle; nodes that have not joined by then keep trying."""
        join = self.scenario.join
        self.run(self.start_all())
        end = self.clock.seconds() + join.within
        while not self.is_joined() and self.clock.seconds() < end:
            self.run(0.5)
        self.run(join.settle)

    # -- lives ------------------------------------------------------------------------------------------------------

    def start(self, place: int, known: Sequence[int] | None = None) -> Node:
        """Start a node at a place; it joins through the nodes at the places ``known`` (None: some joined nodes)."""
        if place in self.living:
            raise ValueError(f"the node at place {place} is alive")
        here = self._places[place]
        if self.life_numbers[place]:
            here.store = restore_store(here.store, self._make_store(place), self.clock.seconds())
        here.join_waiters = []
        through = [self.address(other) for other in (self._draw_known(place) if known is None else known)]
        node = self._make_node(place, here, through)
        self.report_event("born", place, here.identity.node_id.hex())
        self.begin_life(place, node, here.identity)
        life = self.life_numbers[place]
        if isinstance(node, SwarmNode):
            node.startService()
            joined: Deferred[Any] = node.joined
        else:
            node.start()
            joined = node.join(through)
        joined.addCallback(lambda _: self._on_joined(place, life))
        # The node may be killed before it has joined.
        joined.addErrback(lambda failure: failure.trap(NotRunning))
        joined.addErrback(lambda failure: self._log.failure("joining failed", failure))
        return node

    def add(self, known: Sequence[int] | None = None) -> int:
        """Start a new node at a new place; return the place."""
        place = self._new_place()
        self.start(place, known)
        return place

    def kill(self, place: int) -> None:
        """Kill a node as by a loss of power; its disk does not change."""
        node = self._end_node(place, "killed")
        here = self._places[place]
        if here.machine is not None:
            here.machine.die()
        if isinstance(here.store, SimulatedDisk):
            here.store.lose_power()
        node.stop_silently()

    def leave(self, place: int) -> None:
        """Let a node leave gracefully; a frozen node is killed."""
        machine = self._places[place].machine
        if machine is not None and machine.is_frozen:
            self.kill(place)
            return
        node = self._end_node(place, "left")
        if isinstance(node, SwarmNode):
            node.stopService()
        else:
            node.stop()
        self._places[place].store.close()

    def replace(self, place: int) -> None:
        """Start a new node, with a new identity and an empty store, at the place of a node that has ended."""
        if place in self.living:
            raise ValueError(f"the node at place {place} is alive")
        here = self._places[place]
        here.identity = self._make_identity(place, self.life_numbers[place])
        here.store = self._make_store(place)  # an empty store for the new node

    def freeze(self, place: int) -> None:
        """Freeze a node; raises ``ValueError`` if the scenario has no simulated machines."""
        self._get_machine(place).freeze()
        self.report_event("frozen", place)

    def thaw(self, place: int) -> None:
        """Let a frozen node continue."""
        self.report_event("thawed", place)
        self._get_machine(place).thaw()

    def stop(self) -> None:
        """End every node."""
        for place in self.alive():
            self.leave(place)

    # -- inside -----------------------------------------------------------------------------------------------------

    def _new_place(self) -> int:
        place = len(self._places)
        address = Address(f"10.{place >> 16}.{place >> 8 & 255}.{place & 255}", FIRST_PORT)
        here = PlaceState(address, self._make_identity(place, 0), self._make_store(place))
        scenario, place_rng = self.scenario, self.make_rng(f"place/{place}")
        if scenario.clocks.drift:
            here.rate = 1 + place_rng.uniform(-1, 1) * scenario.clocks.drift
        if scenario.clocks.wall:
            here.wall_error = place_rng.uniform(-1, 1) * scenario.clocks.wall
        nat = scenario.nat
        if nat.share and place >= scenario.join.known and place_rng.random() < nat.share:
            kind: Any = nat.kinds[place % len(nat.kinds)]
            here.nat = self.switchboard.add_router(
                NatRouter(kind, f"100.{place >> 16}.{place >> 8 & 255}.{place & 255}", place_rng)
            )
        self._places.append(here)
        return place

    def _make_identity(self, place: int, lives: int) -> Identity:
        return Identity(self.make_rng(f"identity/{place}/{lives}").randbytes(32))

    def _make_store(self, place: int) -> SurvivingMemory:
        return SimulatedDisk(self.clock, self._rng) if self.scenario.has_disks else SurvivingMemory()

    def _make_node(self, place: int, here: PlaceState, known: Sequence[Address]) -> Node:
        port = self.switchboard.make_network(*here.address, here.nat, here.traffic)
        network: Network = port
        clock: IReactorTime = self.clock
        if self.scenario.has_machines:
            clock = here.machine = Machine(self.clock, here.rate)
            network = MachineNetwork(here.machine, port)
        rng = self.make_rng(f"{place}/{self.life_numbers[place] + 1}")  # different numbers in each life

        def wall() -> float:
            return self.clock.seconds() + here.wall_error

        lease = self.scenario.lease
        if self.scenario.kind == "entangled":
            return EntangledNode(here.identity, TEAM_KEY, network, here.store, clock, rng, lease, wall)
        device = Device("", f"dog{place}", capabilities=CAPABILITIES)
        return SwarmNode(device, here.identity, TEAM_KEY, known, network, here.store, clock, rng, wall, lease)

    def _draw_known(self, place: int) -> list[int]:
        """Return the places of the nodes that a new node knows: some joined nodes, or the first node."""
        others = self._joined if self._joined else [other for other in list(self.living)[:1] if other != place]
        count = min(self.scenario.join.known, len(others))
        if self.scenario.nat.share:  # nodes behind a router cannot be reached without an introduction
            others = [other for other in others if self._places[other].nat is None]
            count = min(count, len(others))
        return self._rng.sample(others, count)

    def _on_joined(self, place: int, life: int) -> None:
        here = self._places[place]
        if self.life_numbers[place] != life or place not in self.living or here.join_waiters is None:
            return
        self._joined_index[place] = len(self._joined)
        self._joined.append(place)
        waiting, here.join_waiters = here.join_waiters, None
        self.report_event("entered", place)
        for done in waiting:
            done.callback(True)

    def _end_node(self, place: int, how: str) -> Node:
        node: Node = self.end_life(place)
        at = self._joined_index.pop(place, None)
        if at is not None:
            last = self._joined.pop()
            if last != place:
                self._joined[at], self._joined_index[last] = last, at
        self.report_event(how, place)
        waiting, self._places[place].join_waiters = self._places[place].join_waiters or [], None
        for done in waiting:
            done.callback(False)
        return node

    def _get_machine(self, place: int) -> Machine:
        machine = self._places[place].machine
        if machine is None:
            raise ValueError("the scenario has no simulated machines; write [clocks] drift = 0.001")
        return machine
