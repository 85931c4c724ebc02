"""The network interface of this node's lease acceptor: checks requests, and replies after the state is durable.

The roles of callers are checked before (``middleware.admission.roles``): only nodes that may order tasks reach
``lease.cancel``.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any
from weakref import WeakValueDictionary

from twisted.internet.defer import Deferred, maybeDeferred
from twisted.internet.interfaces import IReactorTime
from twisted.internet.task import deferLater

from middleware.consensus.lease.acceptor import LeaseAcceptor
from middleware.consensus.lease.charter import LEAST, Judge, sign_change, sign_end
from middleware.consensus.lease.lease_codec import MAX_COUNCIL, members_of, pack_reply
from middleware.entangled.contact import Contact
from middleware.entangled.data.store import Store
from middleware.entangled.errors import Refused
from middleware.entangled.identity import Identity
from middleware.entangled.quorum.ballot import MAX_NUMBER, NONE, Ballot
from middleware.entangled.quorum.register import Kind, Reply
from middleware.entangled.record import MAX_NAME
from middleware.entangled.wire.endpoint import Endpoint
from middleware.entangled.wire.method import Method

if TYPE_CHECKING:
    from middleware.consensus.lease.lessee import Lessee

MAX_TTL = 60.0

Answer = list[object] | Deferred[list[object]]


class Desk:
    """The acceptor of one node, and its lease clients that wait for notifications of other acceptors.

    It may be created at the first request: ``born_at`` is the time at which the node started, for its initial quiet
    period.  ``judge`` reads charters; ``may_sit`` returns whether the owner of a key may be a quorum member.
    """

    def __init__(
        self,
        endpoint: Endpoint,
        identity: Identity,
        store: Store,
        clock: IReactorTime,
        born_at: float,
        judge: Judge,
        may_sit: Callable[[bytes], bool],
    ) -> None:
        self._endpoint = endpoint
        self._identity = identity
        self._judge = judge
        self._may_sit = may_sit
        self._store = store
        self._clock = clock
        self._acceptor = LeaseAcceptor(store, born_at)
        self._lessees: WeakValueDictionary[str, Lessee] = WeakValueDictionary()
        self._contacts: dict[str, Contact] = {}
        self._methods = {
            name: Method(name, answer)
            for name, answer in (
                ("lease.prepare", self._prepare),
                ("lease.propose", self._propose),
                ("lease.release", self._release),
                ("lease.close", self._close),
                ("lease.cancel", self._cancel),
                ("lease.change", self._change),
                ("lease.install", self._install),
                ("lease.freed", self._freed),
            )
        }

    def answer(self, method: str, peer: Contact, arguments: tuple[Any, ...]) -> object:
        """Handle a peer's request; raises ``Refused`` for invalid arguments."""
        return self._methods[method].run(peer, arguments)

    def enter(self, lessee: Lessee) -> None:
        """Register ``lessee`` for notifications that its lease was released."""
        self._lessees[lessee.task_id] = lessee

    def ask(
        self, own: Contact, member: Contact, method: str, arguments: tuple[Any, ...], patience: float
    ) -> Deferred[Any]:
        """Send a request to a member, which may be this node itself."""
        if member.node_id == own.node_id:
            return maybeDeferred(self.answer, method, own, arguments)
        return self._endpoint.ask(member, method, *arguments, changes=True, timeout=patience)

    # -- requests of peers ------------------------------------------------------------------------------------------

    def _prepare(self, peer: Contact, task_id: str, configuration: int, counter: int, ttl: float) -> Answer:
        _check(task_id, configuration, counter + 1, ttl=ttl)
        agent = self._remember(peer)
        ballot = Ballot(counter, agent)
        return self._after_write(
            self._acceptor.prepare(task_id, configuration, ballot, float(ttl), self._clock.seconds())
        )

    def _propose(self, peer: Contact, task_id: str, configuration: int, counter: int, token: int, ttl: float) -> Answer:
        _check(task_id, configuration, counter, token, ttl=ttl)
        ballot, ttl = Ballot(counter, peer.node_id.hex()), float(ttl)

        def proposed() -> Reply:
            return self._acceptor.lease(task_id, configuration, ballot, token, ttl, self._clock.seconds())

        return in_time(proposed, self._clock).addCallback(self._after_write)

    def _release(self, peer: Contact, task_id: str, counter: int, rest: float) -> None:
        _check(task_id, counter, rest=rest)
        ballot = Ballot(counter, peer.node_id.hex())
        self._notify(self._acceptor.free(task_id, ballot, self._clock.seconds(), float(rest)), task_id, rest)

    def _close(self, peer: Contact, task_id: str, configuration: int, token: int) -> Answer:
        _check(task_id, configuration, token)
        agent, now = peer.node_id.hex(), self._clock.seconds()
        reply = self._acceptor.close(task_id, agent, configuration, token, now)
        if reply.kind in (Kind.OVER, Kind.SEALED):
            reply = reply._replace(proof=sign_end(self._identity, task_id, configuration, agent, token))
        return self._after_write(reply)

    def _cancel(self, peer: Contact, task_id: str, configuration: int) -> Answer:
        _check(task_id, configuration)
        return self._after_write(self._acceptor.close(task_id, "", configuration, 0, self._clock.seconds()))

    def _change(
        self,
        peer: Contact,
        task_id: str,
        configuration: int,
        counter: int,
        packed: list[object],
        token: int,
        keep: bool,
    ) -> Answer:
        _check(task_id, configuration, counter, token + 1)
        members = members_of(packed)
        if members is None or len(members) < LEAST or not all(self._may_sit(member.public) for member in members):
            raise Refused(
                f"new quorum members must be {LEAST} to {MAX_COUNCIL} members of the team that are not viewers"
            )
        ballot, now = Ballot(counter, peer.node_id.hex()), self._clock.seconds()
        reply = self._acceptor.accept(task_id, configuration, ballot, members, now, token, keep)
        if reply.kind is Kind.GRANTED:
            signature = sign_change(self._identity, task_id, configuration, ballot, members, reply.token)
            reply = reply._replace(proof=signature)
        return self._after_write(reply)

    def _install(self, peer: Contact, task_id: str, packed: bytes, keep: bool, ttl: float) -> Answer:
        _check(task_id, ttl=ttl)
        charter = self._judge.read(task_id, packed)
        if charter is None or not charter.links:
            raise Refused("new quorum members need the signatures of a majority of the previous ones")
        is_own_change = keep and charter.ballot.proposer == peer.node_id.hex()
        reply = self._acceptor.install(
            task_id,
            charter.configuration,
            charter.members,
            charter.token,
            self._clock.seconds(),
            charter.ballot if is_own_change else NONE,
            float(ttl),
            packed,
        )
        return self._after_write(reply)

    def _freed(self, peer: Contact, task_id: str, token: int, rest: float) -> None:
        _check(task_id, token + 1, rest=rest)
        agent, now = peer.node_id.hex(), self._clock.seconds()
        self._notify(self._acceptor.freed(task_id, agent, token, now, float(rest)), task_id, rest)
        lessee = self._lessees.get(task_id)
        if lessee is not None:
            lessee.freed(token, float(rest))

    # -- inside -----------------------------------------------------------------------------------------------------

    def _notify(self, agents: list[str], task_id: str, rest: float) -> None:
        """Notify waiting agents that a lease was released."""
        for agent in agents:
            contact = self._contacts.get(agent)
            if contact is not None:
                self._endpoint.tell(contact, "lease.freed", task_id, 0, rest)

    def _remember(self, peer: Contact) -> str:
        """Remember an agent's contact for notifications, and return its id."""
        agent = peer.node_id.hex()
        self._contacts.pop(agent, None)
        if len(self._contacts) >= 256:
            del self._contacts[next(iter(self._contacts))]
        self._contacts[agent] = peer
        return agent

    def _after_write(self, reply: Reply) -> Answer:
        """Return the reply after all that it promises is durable."""
        packed = pack_reply(reply)
        written = self._store.written()
        return packed if written.called and written.result is None else written.addCallback(lambda _: packed)


def _check(task_id: str, *numbers: int, ttl: float = 1.0, rest: float = 0.0) -> None:
    if len(task_id) > MAX_NAME or not all(0 < number < MAX_NUMBER for number in numbers):
        raise Refused(
            f"a lease request needs a task id of at most {MAX_NAME} characters and positive numbers below 2^62"
        )
    if not 0.0 < ttl <= MAX_TTL:
        raise Refused(f"the TTL of a lease must be more than 0 and at most {MAX_TTL:g} seconds")
    if not 0.0 <= rest <= MAX_TTL:
        raise Refused(f"the time in which a robot stops must be 0 to {MAX_TTL:g} seconds")


MOST_WAIT_S = 0.15
"""Maximum seconds for which a reply is delayed."""
MIN_WAIT_S = 0.001
"""Minimum seconds between two attempts of a delayed proposal."""


def in_time(propose: Callable[[], Reply], clock: IReactorTime) -> Deferred[Reply]:
    """Return the reply to a proposal, delayed if only the imminent end of another lease prevents a grant.

    This saves a round trip, and a guess at its duration, between the end of one lease and the start of the next.
    """
    return Deferred.fromCoroutine(_in_time(propose, clock))


async def _in_time(propose: Callable[[], Reply], clock: IReactorTime) -> Reply:
    reply = propose()
    while reply.kind is Kind.HELD and reply.remaining <= MOST_WAIT_S:
        await deferLater(clock, max(MIN_WAIT_S, reply.remaining))
        reply = propose()
    return reply
