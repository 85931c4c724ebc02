"""Simulate machines, acceptors, agents and devices on a radio link, for schedules and trials of leases.

A place is a machine on which nodes run one after the other. ``LeaseNode`` is one run (life) of a node, ``LeaseTeam``
contains all places, and ``LeaseRecorder`` records the events for the checker (E1 to E9).
"""

from __future__ import annotations

import random
from collections.abc import Callable, Sequence
from typing import Any

from twisted.internet.defer import Deferred, maybeDeferred

from drivers.driver import Permit
from drivers.errors import StaleCommand
from drivers.gate import Gate
from middleware.consensus.lease.charter import Charter, CharterVerifier, create_charter
from middleware.consensus.lease.lease_client import LeaseClient
from middleware.consensus.lease.lease_proposer import LeaseProposer
from middleware.consensus.lease.lease_service import LeaseService
from middleware.entangled.contact import Contact
from middleware.entangled.data.store import Store
from middleware.entangled.errors import Refused
from middleware.entangled.identity import Identity
from middleware.entangled.network.network import Address
from middleware.entangled.network.switchboard import Switchboard
from middleware.entangled.quorum.ballot import majority
from sim.team.checker import find_violations
from sim.team.event import (
    Assumptions,
    Born,
    CommandReceived,
    CommandSent,
    Died,
    LeaseHeld,
    LeaseWon,
    MajorityReachable,
    RobotStopped,
)
from sim.team.leases.radio_link import RadioLink
from sim.team.machine import Machine
from sim.team.simulation import Simulation

TICK_S = 0.1
SEND_DELAY_S = 0.002
"""Seconds from an agent's check of its lease until its command is sent."""
LINK_DELAY_S = 0.001


class LeaseNode:
    """One life of the node at a place: its acceptor, its lease clients, its robot."""

    def __init__(self, world: LeaseTeam, place: int, machine: Machine, store: Store, rng: random.Random) -> None:
        self.world = world
        self.place = place
        self.machine = machine
        identity, born_at = world.identities[place], machine.seconds()
        self._service = LeaseService(
            self,  # type: ignore[arg-type]
            identity,
            store,
            machine,
            born_at,
            world.charter_verifier,
            lambda public: True,
        )
        self.acceptor = self._service._acceptor
        self.lease_clients: dict[str, LeaseClient] = {}
        self._gates: dict[str, Gate] = {}
        self._rng = rng
        machine.callLater(rng.random() * world.tick, self._tick)

    # -- the agent --------------------------------------------------------------------------------------------------

    def get_lease_client(self, task_id: str) -> LeaseClient:
        """Return this agent's lease client for a task."""
        if task_id not in self.lease_clients:
            charter = self.world.get_charter(self.place, task_id)
            council: LeaseProposer = LeaseProposer(
                task_id,
                self.world.contacts[self.place].node_id.hex(),
                self.world.ttl,
                charter.members,
                self._ask,
                self.machine,
                self._rng,
                charter,
                self.world.charter_verifier.parse,
                charter.configuration,
                self.world.recorder.get_highest_token(self.place, task_id),
                lambda: self.world.on_council_changed(task_id, council),
            )
            changed = lambda: self.world.recorder.on_lease_change(self, task_id)  # noqa: E731
            self.lease_clients[task_id] = LeaseClient(council, self.machine, self._rng, changed, self.world.stop_time)
            self._service.register(self.lease_clients[task_id])
            self._gates[task_id] = Gate()
        return self.lease_clients[task_id]

    def has_lease(self, task_id: str) -> bool:
        """Return whether this agent lives and, by its own clock, holds the lease."""
        lease_client = self.lease_clients.get(task_id)
        return lease_client is not None and lease_client.lease is not None and self.machine.is_alive

    def leave(self, task_id: str, agents: Sequence[int] = ()) -> None:
        """Stop the robot, then release the lease."""
        self.world.recorder.stop_robot(self.place, task_id)
        lease_client = self.lease_clients.get(task_id)
        if lease_client is not None:
            lease_client.release([self.world.contacts[heir] for heir in agents])

    def _tick(self) -> None:
        for task_id, lease_client in self.lease_clients.items():
            lease = lease_client.lease
            if lease is not None:
                now = self.machine.seconds()
                permit = Permit(lease.token, lease.deadline)
                # As in a driver, a command contains the device's last known time and the remaining duration of the
                # lease.
                device_time = self.world.clock.seconds() - self._rng.random() * 0.02
                self.machine.callLater(
                    SEND_DELAY_S, self._send_command, task_id, permit, device_time, lease.deadline - now
                )
        self.machine.callLater(self.world.tick, self._tick)

    def _send_command(self, task_id: str, permit: Permit, device_time: float, remaining: float) -> None:
        lease_client = self.lease_clients[task_id]
        gate = self._gates[task_id]
        try:
            gate.admit(permit, self.machine.seconds())
        except StaleCommand:
            return
        if lease_client.lease is None and not lease_client.token:
            return  # the lease was released during the delay
        self.world.recorder.on_command_sent(self, task_id, permit)
        self.world.clock.callLater(
            LINK_DELAY_S, self.world.recorder.on_command, self, task_id, permit, device_time, remaining
        )

    # -- the wire ---------------------------------------------------------------------------------------------------

    def _ask(self, member: Contact, method: str, arguments: tuple[Any, ...]) -> Deferred[Any]:
        answered: Deferred[Any] = Deferred()
        to = self.world.get_place(member)
        if to == self.place:
            maybeDeferred(self.answer, self.place, method, arguments).chainDeferred(answered)
            return answered

        def come_back(answer: object) -> None:
            if not answered.called:
                answered.callback(answer)

        def ask() -> None:
            self.world.ask(self, to, method, arguments, come_back)

        ask()
        if method == "lease.release":
            self.machine.callLater(0.15, ask)
        return answered

    def notify(self, contact: Contact, method: str, *arguments: Any) -> None:
        """Send a notification to a peer, like ``Endpoint``."""
        self.world.notify(self.place, contact, method, arguments)

    def answer(self, source: int, method: str, arguments: tuple[Any, ...]) -> object:
        """Answer a peer's request; a pending answer is a Deferred, a refused one None."""
        try:
            reply = self._service.answer(method, self.world.contacts[source], arguments)
        except Refused:
            return None
        return reply.result if isinstance(reply, Deferred) and reply.called else reply


class LeaseRecorder:
    """The history of a team, and for each task the gate of its device, its accepted commands, and its lease wins."""

    def __init__(self, world: LeaseTeam) -> None:
        self.history = world.history
        self.device_gates: dict[str, Gate] = {}
        self.accepted: dict[str, list[tuple[float, int, int]]] = {}
        self.wins = 0
        self._world = world
        self._won: dict[tuple[str, int], tuple[int, int]] = {}
        self._unreachable: set[tuple[str, int]] = set()

    @property
    def violations(self) -> list[str]:
        """All violations so far, one line each."""
        return find_violations(self.history)

    def record_assumptions(self) -> None:
        """Record the assumptions that apply from now on."""
        world = self._world
        self.history.record(Assumptions, world.ttl, world.drift, world.stop_time, world.radio.max_delay)

    def add_task(self, task_id: str) -> None:
        """Add a task."""
        self.device_gates[task_id] = Gate()
        self.accepted[task_id] = []

    def on_lease_change(self, bidder: LeaseNode, task_id: str) -> None:
        """Record a won or renewed lease, with the other agents that hold it by their own clocks."""
        lease = bidder.lease_clients[task_id].lease
        if lease is None:
            return
        key = (task_id, bidder.place)
        is_new = self._won.get(key) != (lease.token, id(bidder))
        self._won[key] = lease.token, id(bidder)
        others = [other.place for other in self._world.nodes if other is not bidder and other.has_lease(task_id)]
        self.history.record(LeaseHeld, task_id, bidder.place, tuple(others))
        if is_new:
            self.wins += 1
            self.history.record(LeaseWon, task_id, bidder.place, lease.token)

    def on_command_sent(self, bidder: LeaseNode, task_id: str, permit: Permit) -> None:
        """Record a command that an agent sends under its lease, possibly directly after a freeze of its machine."""
        truly = bidder.machine.to_unsuspended_time(permit.deadline)
        self.history.record(
            CommandSent, task_id, bidder.place, bidder.machine.to_simulator_time(permit.deadline), truly
        )

    def on_command(self, bidder: LeaseNode, task_id: str, permit: Permit, device_time: float, remaining: float) -> None:
        """Let the device of the task, which all agents share, accept or refuse a command."""
        now, gate = self._world.clock.seconds(), self.device_gates[task_id]
        deadline = min(device_time, now) + remaining
        truly, is_accepted = bidder.machine.to_unsuspended_time(permit.deadline), True
        try:
            gate.admit(Permit(permit.token, deadline), now)
        except StaleCommand:
            is_accepted = False
            if gate.token is not None and permit.token < gate.token and bidder.machine.is_alive:
                bidder.machine.deliver_datagram(bidder.lease_clients[task_id].on_higher_token, gate.token)
        else:
            self.accepted[task_id].append((now, permit.token, bidder.place))
        self.history.record(CommandReceived, task_id, bidder.place, permit.token, is_accepted, deadline, truly)

    def get_highest_token(self, place: int, task_id: str) -> int:
        """Return the highest token that the robot of a place has obeyed, as the robot reports it to its agent."""
        return max((token for _, token, one in self.accepted[task_id] if one == place), default=0)

    def stop_robot(self, place: int, task_id: str) -> None:
        """Stop the robot of an agent; the stop does not overtake earlier commands on the link."""
        self._world.clock.callLater(LINK_DELAY_S, self._record_stop, place, task_id)

    def _record_stop(self, place: int, task_id: str) -> None:
        self.history.record(RobotStopped, task_id, place, self._world.clock.seconds() + self._world.stop_time)

    def record_reachability(self) -> None:
        """Record which agents lost or regained a bidirectional connection to a majority of the council."""
        for task_id, charter in self._world.charters.items():
            places = [self._world.get_place(member) for member in charter.members]
            for agent in self._world.agents:
                near = [p for p in places if not {(agent, p), (p, agent)} & self._world.radio.cut]
                is_reached, key = len(near) >= majority(len(places)), (task_id, agent)
                if is_reached == (key in self._unreachable):
                    self._unreachable ^= {key}
                    self.history.record(MajorityReachable, *key, is_reached)


class _CallDatagram(bytes):
    """A datagram that carries a call for the receiver."""

    def __new__(cls, call: Callable[[], object]) -> _CallDatagram:
        made = super().__new__(cls)
        made.call = call
        return made

    call: Callable[[], object]


class LeaseTeam(Simulation):
    """Places whose clocks run at ``rates``; the first ``agents`` places have agents. ``seed`` seeds all generators.

    ``stop_time`` is the time that a robot needs to come to rest, ``drift`` the maximum error of a clock's rate.
    """

    def __init__(
        self,
        seed: str,
        rates: Sequence[float],
        agents: int,
        ttl: float,
        stop_time: float = 0.0,
        drift: float = 0.01,
        has_stores: bool = True,
        tick: float = TICK_S,
    ) -> None:
        super().__init__(seed)
        self.ttl = ttl
        self.stop_time = stop_time
        self.drift = drift
        self.tick = tick
        self.n = len(rates)
        self.agents = list(range(agents))
        self.has_stores = has_stores
        self.radio = RadioLink()
        self.switchboard = Switchboard(self.clock, self.make_rng("radio"))
        self.switchboard.link_model = self.radio
        self._ports = [self.network(place) for place in range(self.n)]
        for port in self._ports:
            port.listen(_run_call)
        self.recorder = LeaseRecorder(self)
        self.recorder.record_assumptions()
        keys = self.make_rng("keys")
        self.identities = [Identity(keys.randbytes(32)) for _ in range(self.n)]
        self.operator = Identity(keys.randbytes(32))
        self.charter_verifier = CharterVerifier(lambda public, task_id: public == self.operator.public)
        self.contacts = [Contact(one.public, self.address(place)) for place, one in enumerate(self.identities)]
        self.charters: dict[str, Charter] = {}
        self._rates = rates
        self._places = {contact.public: n for n, contact in enumerate(self.contacts)}
        self.nodes = [self.start_life(place) for place in range(self.n)]

    def add_task(self, task_id: str, council: Sequence[int]) -> None:
        """Add a task with a fixed council."""
        members = tuple(self.contacts[place] for place in council)
        self.charters[task_id] = create_charter(self.operator, task_id, members)
        self.recorder.add_task(task_id)

    # -- services for bidders ---------------------------------------------------------------------------------------

    def get_place(self, contact: Contact) -> int:
        """Return the place of a contact."""
        return self._places[contact.public]

    def get_charter(self, place: int, task_id: str) -> Charter:
        """Return the charter of the task's current council, as its records would prove it."""
        return self.charters[task_id]

    def on_council_changed(self, task_id: str, council: LeaseProposer) -> None:
        """Record a newer council of a task."""
        if council.charter is not None and council.configuration > self.charters[task_id].configuration:
            self.charters[task_id] = council.charter
            self.recorder.record_reachability()

    def send(self, source: int, to: int, call: Callable[[], object]) -> None:
        """Run ``call`` at the receiver if the link delivers the datagram."""
        self._ports[source].send(_CallDatagram(call), self.address(to))

    def ask(
        self, me: LeaseNode, to: int, method: str, arguments: tuple[Any, ...], answered: Callable[[object], object]
    ) -> None:
        """Deliver a request and its answer."""

        def arrive() -> None:
            peer = self.nodes[to]

            def reply(answer: object) -> None:
                if answer is not None:
                    self.send(to, me.place, lambda: me.machine.deliver_datagram(answered, answer))

            def run() -> None:
                answer = peer.answer(me.place, method, arguments)
                if isinstance(answer, Deferred):
                    answer.addCallback(reply)
                else:
                    reply(answer)

            peer.machine.deliver_datagram(run)

        self.send(me.place, to, arrive)

    def notify(self, source: int, contact: Contact, method: str, arguments: tuple[Any, ...]) -> None:
        """Deliver a notification."""
        to = self.get_place(contact)

        def arrive() -> None:
            self.nodes[to].machine.deliver_datagram(self.nodes[to].answer, source, method, arguments)

        self.send(source, to, arrive)

    # -- lives ------------------------------------------------------------------------------------------------------

    def is_up(self, place: int) -> bool:
        """Return whether the machine at a place runs."""
        return self.nodes[place].machine.is_alive and not self.nodes[place].machine.is_frozen

    def kill(self, place: int) -> None:
        """Kill a machine as by a loss of power; its store remains."""
        self.nodes[place].machine.die()
        if not self.has_stores:
            self.stores.pop(place, None)
        self.history.record(Died, place, not self.has_stores)

    def start_life(self, place: int) -> LeaseNode:
        """Start and return the next life of the node at a place."""
        rng = self.make_life_rng(place)
        self.history.record(Born, place, self.life_count)
        machine = Machine(self.clock, self._rates[place], rng.uniform(0.0, 1e4))
        return LeaseNode(self, place, machine, self.store(place), rng)


def _run_call(datagram: bytes, source: Address) -> None:
    assert isinstance(datagram, _CallDatagram)
    datagram.call()
