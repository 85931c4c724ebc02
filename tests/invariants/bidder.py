"""Bidder: one place of the lease schedules: an acceptor, and perhaps an agent with a robot that obeys a device gate."""

from __future__ import annotations

import random
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from twisted.internet.defer import Deferred, maybeDeferred

from drivers.driver import Permit
from drivers.errors import StaleCommand
from drivers.gate import Gate
from middleware.commitment.acceptor import LeaseAcceptor
from middleware.commitment.charter import sign_change, sign_end
from middleware.commitment.council import Council
from middleware.commitment.lease_codec import members_of, pack_reply
from middleware.commitment.lessee import Lessee
from middleware.commitment.patience import in_time
from middleware.entangled.data.store import Store
from middleware.entangled.identity import Identity
from middleware.entangled.kademlia.contact import Contact
from middleware.entangled.quorum.ballot import NONE, Ballot
from middleware.entangled.quorum.register import Kind, Reply
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
        self.acceptor = LeaseAcceptor(store, machine.seconds())
        self.lessees: dict[str, Lessee] = {}
        self._gates: dict[str, Gate] = {}
        self._rng = rng
        self._methods: dict[str, Callable[..., object]] = {
            "lease.prepare": self._prepare,
            "lease.propose": self._propose,
            "lease.release": self._release,
            "lease.close": self._close,
            "lease.cancel": self._cancel,
            "lease.change": self._change,
            "lease.install": self._install,
            "lease.freed": self.freed,
        }
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

    def freed(self, agent: str, task_id: str, token: int, rest: float) -> None:
        """Hear that the lease was given back."""
        self._tell(self.acceptor.freed(task_id, agent, token, self.machine.seconds(), rest), task_id, rest)
        lessee = self.lessees.get(task_id)
        if lessee is not None:
            lessee.freed(token, rest)

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

    def answer(self, source: int, method: str, arguments: tuple[Any, ...]) -> object:
        """Do what a peer asks; an answer that is not there yet is a Deferred."""
        agent = self.world.contacts[source].node_id.hex()
        reply = self._methods[method](agent, *arguments)
        if isinstance(reply, Deferred):
            packed: Deferred[object] = reply.addCallback(pack_reply)
            return packed.result if packed.called else packed
        return pack_reply(reply) if isinstance(reply, Reply) else reply

    def _prepare(self, agent: str, task_id: str, configuration: int, counter: int, ttl: float) -> Reply:
        return self.acceptor.prepare(task_id, configuration, Ballot(counter, agent), ttl, self.machine.seconds())

    def _propose(
        self, agent: str, task_id: str, configuration: int, counter: int, token: int, ttl: float
    ) -> Deferred[Reply]:
        def proposed() -> Reply:
            ballot, now = Ballot(counter, agent), self.machine.seconds()
            return self.acceptor.lease(task_id, configuration, ballot, token, ttl, now)

        return in_time(proposed, self.machine)

    def _release(self, agent: str, task_id: str, counter: int, rest: float) -> None:
        freed = self.acceptor.free(task_id, Ballot(counter, agent), self.machine.seconds(), rest)
        self._tell(freed, task_id, rest)

    def _tell(self, listeners: Sequence[str], task_id: str, rest: float) -> None:
        for listener in listeners:
            self.world.tell_freed(self.place, listener, task_id, rest)

    def _close(self, agent: str, task_id: str, configuration: int, token: int) -> Reply:
        reply = self.acceptor.close(task_id, agent, configuration, token, self.machine.seconds())
        signature = sign_end(self._identity, task_id, configuration, agent, token)
        return reply._replace(proof=signature) if reply.kind in (Kind.OVER, Kind.SEALED) else reply

    def _cancel(self, agent: str, task_id: str, configuration: int) -> Reply:
        return self.acceptor.close(task_id, "", configuration, 0, self.machine.seconds())

    def _change(
        self, agent: str, task_id: str, configuration: int, counter: int, packed: list[object], token: int, keep: bool
    ) -> Reply:
        members, ballot = members_of(packed) or (), Ballot(counter, agent)
        reply = self.acceptor.accept(task_id, configuration, ballot, members, self.machine.seconds(), token, keep)
        signature = sign_change(self._identity, task_id, configuration, ballot, members, reply.token)
        return reply._replace(proof=signature) if reply.kind is Kind.GRANTED else reply

    def _install(self, agent: str, task_id: str, packed: bytes, keep: bool, ttl: float) -> Reply | None:
        charter = self.world.judge.read(task_id, packed)
        if charter is None or not charter.links:
            return None
        ballot = charter.ballot if keep and charter.ballot.proposer == agent else NONE
        told = charter.configuration, charter.members, charter.token, self.machine.seconds(), ballot, ttl, packed
        return self.acceptor.install(task_id, *told)

    @property
    def _identity(self) -> Identity:
        return self.world.identities[self.place]
