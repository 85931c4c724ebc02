"""Bidder: one place of the lease schedules: an acceptor, and perhaps an agent with a robot that obeys a device gate."""

from __future__ import annotations

import random
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from twisted.internet.defer import Deferred, maybeDeferred

from drivers.driver import Permit
from drivers.errors import StaleCommand
from drivers.gate import Gate
from middleware.commitment.council import Council
from middleware.commitment.desk import Desk
from middleware.commitment.lessee import Lessee
from middleware.entangled.data.store import Store
from middleware.entangled.errors import Refused
from middleware.entangled.kademlia.contact import Contact
from tests.invariants.machine import Machine

if TYPE_CHECKING:
    from tests.invariants.team import Team

TICK = 0.1
ACT = 0.002
"""Seconds between an agent's look at its lease and the command on the wire."""
WIRE = 0.001


class Bidder:
    """One life of a place: its acceptor, its claims, its robot."""

    def __init__(self, world: Team, place: int, machine: Machine, store: Store, rng: random.Random) -> None:
        self.world = world
        self.place = place
        self.machine = machine
        identity, born_at = world.identities[place], machine.seconds()
        self._desk = Desk(self, identity, store, machine, born_at, world.judge, lambda public: True)  # type: ignore[arg-type]
        self.acceptor = self._desk._acceptor
        self.lessees: dict[str, Lessee] = {}
        self._gates: dict[str, Gate] = {}
        self._rng = rng
        machine.callLater(rng.random() * world.tick, self._tick)

    # -- the agent --------------------------------------------------------------------------------------------------

    def lessee(self, task_id: str) -> Lessee:
        """This agent's claim on a task."""
        if task_id not in self.lessees:
            charter = self.world.council_for(self.place, task_id)
            council = Council(
                task_id,
                self.world.contacts[self.place].node_id.hex(),
                self.world.ttl,
                charter.members,
                self._ask,
                self.machine,
                self._rng,
                charter,
                self.world.judge.read,
                charter.configuration,
                self.world.referee.floor(self.place, task_id),
            )
            council.moved = lambda: self.world.moved(task_id, council)
            changed = lambda: self.world.referee.on_change(self, task_id)  # noqa: E731
            self.lessees[task_id] = Lessee(council, self.machine, self._rng, changed, self.world.stop_time)
            self._desk.enter(self.lessees[task_id])
            self._gates[task_id] = Gate()
        return self.lessees[task_id]

    def holds(self, task_id: str) -> bool:
        """Whether this agent lives and believes to hold a lease."""
        lessee = self.lessees.get(task_id)
        return lessee is not None and lessee.lease is not None and self.machine.is_alive

    def leave(self, task_id: str, heirs: Sequence[int] = ()) -> None:
        """Stop the robot, then give the lease back."""
        self.world.referee.stop(self.place, task_id)
        lessee = self.lessees.get(task_id)
        if lessee is not None:
            lessee.release([self.world.contacts[heir] for heir in heirs])

    def _tick(self) -> None:
        for task_id, lessee in self.lessees.items():
            lease = lessee.lease
            if lease is not None:
                now = self.machine.seconds()
                permit = Permit(lease.token, lease.deadline)
                # As a driver does: the device's time as it was told lately, and how long the lease lasts from then on.
                told = self.world.clock.seconds() - self._rng.random() * 0.02
                self.machine.callLater(ACT, self._act, task_id, permit, told, lease.deadline - now)
        self.machine.callLater(self.world.tick, self._tick)

    def _act(self, task_id: str, permit: Permit, told: float, remaining: float) -> None:
        lessee = self.lessees[task_id]
        gate = self._gates[task_id]
        try:
            gate.admit(permit, self.machine.seconds())
        except StaleCommand:
            return
        if lessee.lease is None and not lessee.token:
            return  # it was given back meanwhile
        self.world.referee.on_issue(self, task_id, permit)
        self.world.clock.callLater(WIRE, self.world.referee.on_command, self, task_id, permit, told, remaining)

    # -- the wire ---------------------------------------------------------------------------------------------------

    def _ask(self, member: Contact, method: str, arguments: tuple[Any, ...]) -> Deferred[Any]:
        answered: Deferred[Any] = Deferred()
        to = self.world.place_of(member)
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

    def tell(self, contact: Contact, method: str, *arguments: Any) -> None:
        """Tell a peer something, as an ``Endpoint`` does."""
        self.world.tell(self.place, contact, method, arguments)

    def answer(self, source: int, method: str, arguments: tuple[Any, ...]) -> object:
        """Do what a peer asks; an answer that is not there yet is a Deferred, one that is refused None."""
        try:
            reply = self._desk.answer(method, self.world.contacts[source], arguments)
        except Refused:
            return None
        return reply.result if isinstance(reply, Deferred) and reply.called else reply
