"""The lease service of a node: check requests of peers, pass them to the acceptor, and reply after the write.

The role of the caller has already been checked (``middleware.admission.roles``), so only nodes that may order tasks can
call ``lease.cancel``.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any
from weakref import WeakValueDictionary

from twisted.internet.defer import Deferred, maybeDeferred
from twisted.internet.interfaces import IReactorTime
from twisted.internet.task import deferLater

from middleware.consensus.lease.acceptor import LeaseAcceptor
from middleware.consensus.lease.charter import MIN_MEMBERS, CharterVerifier, sign_change, sign_end
from middleware.consensus.lease.lease_codec import MAX_COUNCIL, pack_reply, parse_members
from middleware.entangled.contact import Contact
from middleware.entangled.data.store import Store
from middleware.entangled.errors import Refused
from middleware.entangled.identity import Identity
from middleware.entangled.quorum.ballot import MAX_NUMBER, NO_BALLOT, Ballot
from middleware.entangled.quorum.register import Reply, ReplyKind
from middleware.entangled.record import MAX_NAME_BYTES
from middleware.entangled.wire.endpoint import Endpoint
from middleware.entangled.wire.method import Method

if TYPE_CHECKING:
    from middleware.consensus.lease.lease_client import LeaseClient

MAX_TTL_S = 60.0

Answer = list[object] | Deferred[list[object]]


class LeaseService:
    """The lease service of one node: its acceptor, and the lease clients that are notified of releases.

    The service may be created at the first request.  ``born_at`` is the time at which the node started; from this, the
    acceptor computes how long it has to be silent.  ``charter_verifier`` checks charters; ``may_be_member`` returns
    whether the owner of a key may be a council member.
    """

    def __init__(
        self,
        endpoint: Endpoint,
        identity: Identity,
        store: Store,
        clock: IReactorTime,
        born_at: float,
        charter_verifier: CharterVerifier,
        may_be_member: Callable[[bytes], bool],
    ) -> None:
        self._endpoint = endpoint
        self._identity = identity
        self._charter_verifier = charter_verifier
        self._may_be_member = may_be_member
        self._store = store
        self._clock = clock
        self._acceptor = LeaseAcceptor(store, born_at)
        self._clients: WeakValueDictionary[str, LeaseClient] = WeakValueDictionary()
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
                ("lease.freed", self._on_released),
            )
        }

    def answer(self, method: str, peer: Contact, arguments: tuple[Any, ...]) -> object:
        """Run a method for a peer, and return the answer; raise ``Refused`` for invalid arguments."""
        return self._methods[method].run(peer, arguments)

    def register(self, client: LeaseClient) -> None:
        """Notify ``client`` when the lease of its task is released."""
        self._clients[client.task_id] = client

    def call_member(
        self, own: Contact, member: Contact, method: str, arguments: tuple[Any, ...], timeout_s: float
    ) -> Deferred[Any]:
        """Call a method of a member, which may be this node itself."""
        if member.node_id == own.node_id:
            return maybeDeferred(self.answer, method, own, arguments)
        return self._endpoint.ask(member, method, *arguments, changes=True, timeout=timeout_s)

    # -- requests of peers ---------------------------------------------------------------------------------------------

    def _prepare(self, peer: Contact, task_id: str, configuration: int, counter: int, ttl: float) -> Answer:
        _check_arguments(task_id, configuration, counter + 1, ttl=ttl)
        agent = self._remember_agent(peer)
        ballot = Ballot(counter, agent)
        return self._reply_after_write(
            self._acceptor.prepare(task_id, configuration, ballot, float(ttl), self._clock.seconds())
        )

    def _propose(self, peer: Contact, task_id: str, configuration: int, counter: int, token: int, ttl: float) -> Answer:
        _check_arguments(task_id, configuration, counter, token, ttl=ttl)
        ballot, ttl = Ballot(counter, peer.node_id.hex()), float(ttl)

        def propose_now() -> Reply:
            return self._acceptor.lease(task_id, configuration, ballot, token, ttl, self._clock.seconds())

        return propose_when_free(propose_now, self._clock).addCallback(self._reply_after_write)

    def _release(self, peer: Contact, task_id: str, counter: int, rest: float) -> None:
        _check_arguments(task_id, counter, rest=rest)
        ballot = Ballot(counter, peer.node_id.hex())
        self._notify(
            self._acceptor.release_by_ballot(task_id, ballot, self._clock.seconds(), float(rest)), task_id, rest
        )

    def _close(self, peer: Contact, task_id: str, configuration: int, token: int) -> Answer:
        _check_arguments(task_id, configuration, token)
        agent, now = peer.node_id.hex(), self._clock.seconds()
        reply = self._acceptor.close(task_id, agent, configuration, token, now)
        if reply.kind in (ReplyKind.OVER, ReplyKind.SEALED):
            reply = reply._replace(proof=sign_end(self._identity, task_id, configuration, agent, token))
        return self._reply_after_write(reply)

    def _cancel(self, peer: Contact, task_id: str, configuration: int) -> Answer:
        _check_arguments(task_id, configuration)
        return self._reply_after_write(self._acceptor.close(task_id, "", configuration, 0, self._clock.seconds()))

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
        _check_arguments(task_id, configuration, counter, token + 1)
        members = parse_members(packed)
        if (
            members is None
            or len(members) < MIN_MEMBERS
            or not all(self._may_be_member(member.public) for member in members)
        ):
            raise Refused(f"the next council must have {MIN_MEMBERS} to {MAX_COUNCIL} members that may grant leases")
        ballot, now = Ballot(counter, peer.node_id.hex()), self._clock.seconds()
        reply = self._acceptor.accept(task_id, configuration, ballot, members, now, token, keep)
        if reply.kind is ReplyKind.GRANTED:
            signature = sign_change(self._identity, task_id, configuration, ballot, members, reply.token)
            reply = reply._replace(proof=signature)
        return self._reply_after_write(reply)

    def _install(self, peer: Contact, task_id: str, packed: bytes, keep: bool, ttl: float) -> Answer:
        _check_arguments(task_id, ttl=ttl)
        charter = self._charter_verifier.parse(task_id, packed)
        if charter is None or not charter.changes:
            raise Refused("the new council must be signed by a majority of the previous council")
        is_own = keep and charter.ballot.proposer == peer.node_id.hex()
        reply = self._acceptor.install(
            task_id,
            charter.configuration,
            charter.members,
            charter.token,
            self._clock.seconds(),
            charter.ballot if is_own else NO_BALLOT,
            float(ttl),
            packed,
        )
        return self._reply_after_write(reply)

    def _on_released(self, peer: Contact, task_id: str, token: int, rest: float) -> None:
        _check_arguments(task_id, token + 1, rest=rest)
        agent, now = peer.node_id.hex(), self._clock.seconds()
        self._notify(self._acceptor.release_by_token(task_id, agent, token, now, float(rest)), task_id, rest)
        client = self._clients.get(task_id)
        if client is not None:
            client.on_released(token, float(rest))

    # -- inside -----------------------------------------------------------------------------------------------------

    def _notify(self, agents: list[str], task_id: str, rest: float) -> None:
        """Notify ``agents`` that the lease of a task was released."""
        for agent in agents:
            contact = self._contacts.get(agent)
            if contact is not None:
                self._endpoint.notify(contact, "lease.freed", task_id, 0, rest)

    def _remember_agent(self, peer: Contact) -> str:
        """Return the agent id of ``peer``, and store its contact for notifications."""
        agent = peer.node_id.hex()
        self._contacts.pop(agent, None)
        if len(self._contacts) >= 256:
            del self._contacts[next(iter(self._contacts))]
        self._contacts[agent] = peer
        return agent

    def _reply_after_write(self, reply: Reply) -> Answer:
        """Return the reply once the store has written it durably."""
        packed = pack_reply(reply)
        written = self._store.wait_for_write()
        return packed if written.called and written.result is None else written.addCallback(lambda _: packed)


def _check_arguments(task_id: str, *numbers: int, ttl: float = 1.0, rest: float = 0.0) -> None:
    if len(task_id) > MAX_NAME_BYTES or not all(0 < number < MAX_NUMBER for number in numbers):
        raise Refused("a lease request must have a valid task id and positive numbers below 2^62")
    if not 0.0 < ttl <= MAX_TTL_S:
        raise Refused(f"the ttl of a lease must be more than 0 and at most {MAX_TTL_S:g} seconds")
    if not 0.0 <= rest <= MAX_TTL_S:
        raise Refused(f"the time until the robot stops must be 0 to {MAX_TTL_S:g} seconds")


MAX_WAIT_S = 0.15
"""Maximum seconds by which a reply is delayed."""
MIN_WAIT_S = 0.001
"""Minimum seconds before a proposal is retried."""


def propose_when_free(propose: Callable[[], Reply], clock: IReactorTime) -> Deferred[Reply]:
    """Call ``propose``, and fire with its reply; wait if the lease of another agent ends soon.

    If that lease ends within ``MAX_WAIT_S``, ``propose`` is called again at its end.  So the next lease is granted
    without the delay of a round trip.
    """
    return Deferred.fromCoroutine(_propose_when_free(propose, clock))


async def _propose_when_free(propose: Callable[[], Reply], clock: IReactorTime) -> Reply:
    reply = propose()
    while reply.kind is ReplyKind.HELD and reply.remaining <= MAX_WAIT_S:
        await deferLater(clock, max(MIN_WAIT_S, reply.remaining))
        reply = propose()
    return reply
