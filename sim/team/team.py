"""Team: places with nodes in their present lives, on one turned clock and one switchboard.

The nodes are those that ship; only clock, wire, store and dice are the simulation's.  Everything follows from the
scenario and the seed: ``digest`` is the same wherever they are, and whatever else the process does.
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
from middleware.entangled.network.nat import Nat
from middleware.entangled.network.network import Address, Network
from middleware.entangled.network.switchboard import Traffic
from middleware.entangled.node import EntangledNode
from middleware.node import SwarmNode
from sim.team.disk import Disk, Memory, next_life
from sim.team.link import TeamLink
from sim.team.machine import Machine, MachineNetwork
from sim.team.scenario import Scenario
from sim.team.world import CAPABILITIES, PORT, TEAM, World

Node = EntangledNode | SwarmNode
Told = Callable[[float, str, int, str], object]
"""Called with the moment, what happened, at which place (-1: at none), and more about it."""


def core(node: Node) -> EntangledNode:
    """The peer of the network that a node is, or has."""
    return node.entangled if isinstance(node, SwarmNode) else node


class Place:
    """What stays at a place from life to life; ``step`` is how wrong its wall clock is."""

    __slots__ = ("address", "identity", "store", "traffic", "step", "rate", "home", "machine", "entered")

    def __init__(self, address: Address, identity: Identity, store: Memory) -> None:
        self.address = address
        self.identity = identity
        self.store = store
        self.traffic = Traffic()
        self.step = 0.0
        self.rate = 1.0
        self.home: Nat | None = None
        self.machine: Machine | None = None
        self.entered: list[Deferred[bool]] | None = None
        """Those who wait for it to be in the network; None: it is."""


class Team(World):
    """The team of a ``scenario``; nobody is there before ``stand`` or ``come``."""

    seed: int
    living: dict[int, Node]
    _log = Logger()

    def __init__(self, scenario: Scenario, seed: int = 1) -> None:
        super().__init__(seed)
        self.scenario = scenario
        self.link = TeamLink(scenario.link, f"{seed}/spots")
        self.board.link = self.link
        self.told: list[Told] = []
        self._places: list[Place] = []
        self._dice = self.generator("team")
        self._inside: list[int] = []
        self._inside_at: dict[int, int] = {}
        self._hash = hashlib.blake2b(digest_size=32)
        for _ in range(scenario.nodes):
            self._new_place()

    # -- who is there -----------------------------------------------------------------------------------------------

    @property
    def places(self) -> range:
        """Every place that ever was."""
        return range(len(self._places))

    def inside(self) -> list[int]:
        """The places whose nodes are in the network, in no order that means anything; not to be changed."""
        return self._inside

    def address(self, place: int) -> Address:
        """Where the node of a place listens."""
        return self._places[place].address

    def node(self, place: int) -> Node:
        """The node of a place in its present life; ``KeyError`` where there is none."""
        return self.living[place]

    def entangled(self, place: int) -> EntangledNode:
        """The peer of the network that the node of a place is, or has."""
        return core(self.living[place])

    def identity(self, place: int) -> Identity:
        """Who the node of a place is."""
        return self._places[place].identity

    def traffic(self, place: int) -> Traffic:
        """What the node of a place has sent and taken in, in all its lives."""
        return self._places[place].traffic

    def place(self, place: int) -> Place:
        """What stays at a place from life to life."""
        return self._places[place]

    def entered(self, place: int) -> Deferred[bool]:
        """Fire when the node of a place is in the network: with True, or with False if it ends before."""
        done: Deferred[bool] = Deferred()
        waiting = self._places[place].entered
        if place not in self.living:
            done.callback(False)
        elif waiting is None:
            done.callback(True)
        else:
            waiting.append(done)
        return done

    # -- time -------------------------------------------------------------------------------------------------------

    def at(self, seconds: float, call: Callable[[], object]) -> IDelayedCall:
        """Call in so many seconds from now."""
        return self.clock.callLater(seconds, call)

    def tell(self, event: str, place: int = -1, more: str = "") -> None:
        """Write down what happened; it is part of the digest."""
        now = self.clock.seconds()
        self._hash.update(f"{now!r} {event} {place} {more}\n".encode())
        for told in self.told:
            told(now, event, place, more)

    def digest(self) -> str:
        """The hash of every datagram that was delivered and of everything that was told, in hex."""
        whole = self._hash.copy()
        whole.update(self.board.digest().encode())
        return whole.hexdigest()

    # -- coming together --------------------------------------------------------------------------------------------

    def come(self) -> float:
        """Let the team come, as its scenario says; returns in how many seconds the last one comes."""
        join, moment = self.scenario.join, 0.0
        for place in self.places:
            if place and (
                join.how == "one by one"
                or (join.how == "at once" and place == 1)
                or (join.how == "batches" and (place == 1 or (place - 1) % join.size == 0))
            ):
                moment += join.pause
            self.at(moment, partial(self.start, place))
        return moment

    def is_standing(self) -> bool:
        """Whether every node that lives is in the network."""
        return len(self._inside) == len(self.living)

    def stand(self) -> None:
        """Let the team come and settle; who is not in by then is still trying."""
        join = self.scenario.join
        self.run(self.come())
        end = self.clock.seconds() + join.within
        while not self.is_standing() and self.clock.seconds() < end:
            self.run(0.5)
        self.run(join.settle)

    # -- lives ------------------------------------------------------------------------------------------------------

    def start(self, place: int, known: Sequence[int] | None = None) -> Node:
        """The next life of the node of a place; it joins through the ``known`` places (None: some that are in)."""
        if place in self.living:
            raise ValueError(f"the node of place {place} lives")
        here = self._places[place]
        if self.life[place]:
            here.store = next_life(here.store, self._store(place), self.clock.seconds())
        here.entered = []
        through = [self.address(other) for other in (self._known(place) if known is None else known)]
        node = self._made(place, here, through)
        self.tell("born", place, here.identity.node_id.hex())
        self.begin_life(place, node, here.identity)
        life = self.life[place]
        if isinstance(node, SwarmNode):
            node.startService()
            joined: Deferred[Any] = node.joined
        else:
            node.start()
            joined = node.join(through)
        joined.addCallback(lambda _: self._is_in(place, life))
        # It may be killed before it has found anybody.
        joined.addErrback(lambda failure: failure.trap(NotRunning))
        joined.addErrback(lambda failure: self._log.failure("while joining", failure))
        return node

    def add(self, known: Sequence[int] | None = None) -> int:
        """A newcomer, at a place of its own; returns that."""
        place = self._new_place()
        self.start(place, known)
        return place

    def kill(self, place: int) -> None:
        """End a node as a loss of power does; its disk is left as it is."""
        node = self._ends(place, "killed")
        here = self._places[place]
        if here.machine is not None:
            here.machine.die()
        if isinstance(here.store, Disk):
            here.store.lose_power()
        node.vanish()

    def leave(self, place: int) -> None:
        """End a node with a goodbye; one that stands still can say none, and is killed."""
        machine = self._places[place].machine
        if machine is not None and machine.is_still:
            self.kill(place)
            return
        node = self._ends(place, "left")
        if isinstance(node, SwarmNode):
            node.stopService()
        else:
            node.stop()
        self._places[place].store.close()

    def replace(self, place: int) -> None:
        """Let somebody else have the place of a node that has ended: another identity, and an empty store."""
        if place in self.living:
            raise ValueError(f"the node of place {place} lives")
        here = self._places[place]
        here.identity = self._identity(place, self.life[place])
        here.store = self._store(place)  # which is empty, and so is what is left of it

    def freeze(self, place: int) -> None:
        """Let a node stand still; raises ``ValueError`` where the scenario gives it no machine of its own."""
        self._machine(place).freeze()
        self.tell("frozen", place)

    def thaw(self, place: int) -> None:
        """Let a node that stands still go on."""
        self.tell("thawed", place)
        self._machine(place).thaw()

    def stop(self) -> None:
        """End every node."""
        for place in self.alive():
            self.leave(place)

    # -- inside -----------------------------------------------------------------------------------------------------

    def _new_place(self) -> int:
        place = len(self._places)
        address = Address(f"10.{place >> 16}.{place >> 8 & 255}.{place & 255}", PORT)
        here = Place(address, self._identity(place, 0), self._store(place))
        scenario, dice = self.scenario, self.generator(f"place/{place}")
        if scenario.clocks.drift:
            here.rate = 1 + dice.uniform(-1, 1) * scenario.clocks.drift
        if scenario.clocks.wall:
            here.step = dice.uniform(-1, 1) * scenario.clocks.wall
        nat = scenario.nat
        if nat.share and place >= scenario.join.known and dice.random() < nat.share:
            kind: Any = nat.kinds[place % len(nat.kinds)]
            here.home = self.board.router(Nat(kind, f"100.{place >> 16}.{place >> 8 & 255}.{place & 255}", dice))
        self._places.append(here)
        return place

    def _identity(self, place: int, lives: int) -> Identity:
        return Identity(self.generator(f"identity/{place}/{lives}").randbytes(32))

    def _store(self, place: int) -> Memory:
        return Disk(self.clock, self._dice) if self.scenario.has_disks else Memory()

    def _made(self, place: int, here: Place, known: Sequence[Address]) -> Node:
        port = self.board.network(*here.address, here.home, here.traffic)
        network: Network = port
        clock: IReactorTime = self.clock
        if self.scenario.has_machines:
            clock = here.machine = Machine(self.clock, here.rate)
            network = MachineNetwork(here.machine, port)
        rng = self.generator(f"{place}/{self.life[place] + 1}")  # dice never fall as those of a former life

        def wall() -> float:
            return self.clock.seconds() + here.step

        lease = self.scenario.lease
        if self.scenario.kind == "entangled":
            return EntangledNode(here.identity, TEAM, network, here.store, clock, rng, lease, wall)
        device = Device("", f"dog{place}", capabilities=CAPABILITIES)
        return SwarmNode(device, here.identity, TEAM, known, network, here.store, clock, rng, wall, lease)

    def _known(self, place: int) -> list[int]:
        """Whom a node knows: some that are in the network, and first of all the first one."""
        others = self._inside if self._inside else [other for other in list(self.living)[:1] if other != place]
        count = min(self.scenario.join.known, len(others))
        if self.scenario.nat.share:  # who is behind a router cannot be written to by strangers
            others = [other for other in others if self._places[other].home is None]
            count = min(count, len(others))
        return self._dice.sample(others, count)

    def _is_in(self, place: int, life: int) -> None:
        here = self._places[place]
        if self.life[place] != life or place not in self.living or here.entered is None:
            return
        self._inside_at[place] = len(self._inside)
        self._inside.append(place)
        waiting, here.entered = here.entered, None
        self.tell("entered", place)
        for done in waiting:
            done.callback(True)

    def _ends(self, place: int, how: str) -> Node:
        node: Node = self.end_life(place)
        at = self._inside_at.pop(place, None)
        if at is not None:
            last = self._inside.pop()
            if last != place:
                self._inside[at], self._inside_at[last] = last, at
        self.tell(how, place)
        waiting, self._places[place].entered = self._places[place].entered or [], None
        for done in waiting:
            done.callback(False)
        return node

    def _machine(self, place: int) -> Machine:
        machine = self._places[place].machine
        if machine is None:
            raise ValueError("the scenario gives nodes no machines of their own; write [clocks] drift = 0.001")
        return machine
