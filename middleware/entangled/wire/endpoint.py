"""Endpoint: a node's end of the wire; asks, answers and tells in sealed datagrams.

It sorts what arrives, keeps the table of sessions, and drops and counts what does not open.  How questions are repeated
stands in ``asker``, how they are answered in ``answerer``; ``docs/protocol.md`` has every byte.
"""

from __future__ import annotations

import random
from collections import Counter, OrderedDict
from collections.abc import Callable
from typing import Any

from twisted.internet import defer
from twisted.internet.defer import Deferred
from twisted.internet.interfaces import IReactorTime

from middleware.entangled.errors import Forged, Malformed, NotRunning
from middleware.entangled.identity import Identity
from middleware.entangled.kademlia.contact import Contact
from middleware.entangled.network.network import MAX_DATAGRAM, Address, Network
from middleware.entangled.wire.answerer import Answerer
from middleware.entangled.wire.asker import Asker
from middleware.entangled.wire.greeting import HERE, WHO, Greeter
from middleware.entangled.wire.handshake import (
    INIT,
    RESP,
    Acceptance,
    Credentials,
    derived_key,
    ephemeral_of,
    is_init_of_team,
)
from middleware.entangled.wire.message import Answer, Failure, Question, Told, decoded
from middleware.entangled.wire.method import Method
from middleware.entangled.wire.noise import SECOND_OVERHEAD
from middleware.entangled.wire.session import DATA, INDEX_BYTES, OVERHEAD, Session, index_of

PATIENCE = 1.5
MAX_UNCONFIRMED = 512
UNCONFIRMED_S = 10.0
MAX_RESPONSES = 512
RESPONSES_S = 30.0


class Endpoint:
    """The wire of one node.

    ``team_key`` (32 bytes) is the secret of the team: who lacks it can neither read nor be answered.  ``rng`` makes the
    ephemeral keys, so outside of simulations it must be ``random.SystemRandom``, and in them no node may be given dice
    that fall as those of its former life did.

    ``on_contact`` is called when a peer has proved its key and its address: it answered us, or confirmed the session
    that it opened.  ``counters`` counts every datagram that was dropped, by its reason: oversized, unknown,
    malformed, forged, replayed, stale (no such session), repeated, misdirected, unasked; and what was refused for
    want of room.
    """

    def __init__(
        self, identity: Identity, team_key: bytes, network: Network, clock: IReactorTime, rng: random.Random
    ) -> None:
        self.on_contact: Callable[[Contact], None] = lambda contact: None
        self.counters: Counter[str] = Counter()
        self.is_running = False
        self._network = network
        self._clock = clock
        self._rng = rng
        self._own = Credentials.of(identity, team_key)
        self._answerer = Answerer(clock, self._send, self.counters)
        self._asker = Asker(self._own, clock, rng, network, self._sessions_end, self._new_index, self.counters)
        self._greeter = Greeter(identity.public, derived_key(team_key, b"greet"), network, clock, rng, self.counters)
        self._sessions: dict[int, Session] = {}
        self._unconfirmed: OrderedDict[int, Session] = OrderedDict()
        self._responses: OrderedDict[bytes, tuple[float, bytes]] = OrderedDict()
        self._receivers: dict[int, Callable[[bytes, Address], None]] = {
            DATA: self._on_data,
            INIT: self._on_init,
            RESP: self._on_resp,
            WHO: self._greeter.on_who,
            HERE: self._greeter.on_here,
        }

    @property
    def address(self) -> Address:
        """The address of the network underneath."""
        return self._network.address

    def start(self) -> None:
        """Open the network; raises ``PortInUse``."""
        if not self.is_running:
            self._network.listen(self._received)
            self.is_running = True

    def stop(self) -> None:
        """Close the network, forget every session, cancel every timer; what is pending fails with ``NotRunning``."""
        if not self.is_running:
            return
        self.is_running = False
        self._network.close()
        self._answerer.clear()
        self._sessions.clear()
        self._unconfirmed.clear()
        self._responses.clear()
        error = NotRunning("the endpoint was stopped")
        self._greeter.stop(error)
        self._asker.stop(error)

    def expose(self, name: str, answer: Callable[..., object], changes: bool = False) -> None:
        """Let peers call ``answer(peer, *arguments)`` under ``name``.

        It returns something that msgpack can hold, a Deferred or a coroutine of it, or raises ``Refused``, whose text
        the asker gets.  Arguments that do not fit the function's parameters and plain annotations are refused before
        it runs; other exceptions are logged, and the asker gets ``Refused("internal error")``.  With ``changes`` it
        runs only in an established session, and at most once for each question.
        """
        self._answerer.methods[name] = Method(name, answer, changes)

    def ask(
        self, contact: Contact, method: str, *arguments: object, timeout: float | None = None, changes: bool = False
    ) -> Deferred[Any]:
        """Ask a peer, and try again until it answers, at most four times and for ``timeout`` (default 1.5) seconds.

        With a longer ``timeout`` the tries are spread over it, for methods that take their time.  Say ``changes``
        where the method changes something: such a question waits for the session, others ride in the handshake.
        Fails with ``NoAnswer``, ``Refused`` (the peer's text), ``TooLarge``, ``NotRunning``, or with the
        ``TypeError`` of arguments that msgpack cannot hold.
        """
        if not self.is_running:
            return defer.fail(NotRunning("the endpoint is not running; start it first"))
        patience = PATIENCE if timeout is None else timeout
        return self._asker.ask(contact, method, arguments, patience, patience > PATIENCE, changes)

    def tell(self, contact: Contact, method: str, *arguments: object) -> None:
        """Call a peer's method once, without answer and without a second try; raises ``TooLarge`` and ``NotRunning``.

        Opens a session first where there is none.
        """
        if not self.is_running:
            raise NotRunning("the endpoint is not running; start it first")
        self._asker.tell(contact, method, arguments)

    def greet(self, address: Address, timeout: float = PATIENCE) -> Deferred[Contact]:
        """Learn who listens at ``address``; fails with ``NoAnswer``.  The contact has not proved its key yet."""
        if not self.is_running:
            return defer.fail(NotRunning("the endpoint is not running; start it first"))
        return self._greeter.greet(address, timeout)

    def _received(self, datagram: bytes, source: Address) -> None:
        if len(datagram) > MAX_DATAGRAM:
            self.counters["oversized"] += 1
            return
        receiver = self._receivers.get(datagram[0]) if datagram else None
        if receiver is None:
            self.counters["unknown"] += 1
        elif self.is_running:
            receiver(datagram, source)

    def _on_data(self, datagram: bytes, source: Address) -> None:
        if len(datagram) < OVERHEAD:
            self.counters["malformed"] += 1
            return
        session = self._sessions.get(index_of(datagram))
        if session is None:
            self.counters["stale"] += 1
            return
        if session.is_replay(datagram):
            self.counters["replayed"] += 1
            return
        try:
            data, is_newest = session.open(datagram)
        except Forged:
            self.counters["forged"] += 1
            return
        session.heard_at = self._clock.seconds()
        if is_newest and source != session.contact.address:
            session.contact = Contact(session.contact.public, source)
            self._asker.moved(session)
        if not session.is_confirmed:
            session.is_confirmed = True
            self._unconfirmed.pop(session.local_index, None)
            self._asker.established(session)
            self.on_contact(session.contact)
        if data and self.is_running:
            self._read(data, session)

    def _read(self, data: bytes, session: Session) -> None:
        try:
            message = decoded(data)
        except Malformed:
            self.counters["malformed"] += 1
            return
        if isinstance(message, Question):
            self._answerer.answer(message, session)
        elif isinstance(message, Told):
            self._answerer.take(message, session.contact)
        else:
            self._resolve(message, session.contact)

    def _resolve(self, message: Answer | Failure, contact: Contact) -> None:
        if self._asker.is_asked(message.id, contact.public):
            self.on_contact(contact)
        self._asker.resolve(message, contact.public)

    def _on_init(self, datagram: bytes, source: Address) -> None:
        if not is_init_of_team(self._own, datagram):
            self.counters["forged"] += 1
            return
        now = self._clock.seconds()
        known = self._responses.get(ephemeral_of(datagram))
        if known is not None:  # the RESP was lost, or somebody plays a recording: neither costs a key exchange
            self.counters["repeated"] += 1
            self._network.send(known[1], source)
            return
        try:
            acceptance = Acceptance(self._own, datagram, self._rng.randbytes(32))
            rider = decoded(acceptance.rider) if acceptance.rider else None
        except Forged:
            self.counters["forged"] += 1
            return
        except Malformed:
            self.counters["malformed"] += 1
            return
        contact = Contact(acceptance.public, source)
        answer = b""
        if isinstance(rider, Question):
            answer = self._answerer.ride(rider, contact, acceptance.answer_room)
        if not self.is_running:
            return  # the method stopped us
        index = self._new_index()
        response, keys = acceptance.accept(index, answer)
        session = Session(contact, index, acceptance.remote_index, keys, now, is_confirmed=False)
        self._sessions[index] = self._unconfirmed[index] = session
        self._responses[ephemeral_of(datagram)] = (now, response)
        self._trim(now)
        self._network.send(response, source)

    def _on_resp(self, datagram: bytes, source: Address) -> None:
        if len(datagram) < 1 + INDEX_BYTES + SECOND_OVERHEAD:
            self.counters["malformed"] += 1
            return
        opening = self._asker.opening(index_of(datagram))
        if opening is None:
            self.counters["stale"] += 1
            return
        if source != opening.address:
            self.counters["misdirected"] += 1
            return
        try:
            remote_index, data, keys = opening.invitation.accepted(datagram)
        except Forged:
            self.counters["forged"] += 1
            return
        contact = Contact(opening.peer.public, source)
        index = opening.invitation.local_index
        session = Session(contact, index, remote_index, keys, self._clock.seconds(), is_confirmed=True)
        self._sessions[index] = session
        self._asker.accepted(opening)
        self.on_contact(contact)
        message: object = None
        if data:
            try:
                message = decoded(data)
            except Malformed:
                self.counters["malformed"] += 1
        if isinstance(message, Answer | Failure):
            self._asker.resolve(message, contact.public)
        if self.is_running:
            self._asker.established(session, is_owed=True)

    def _trim(self, now: float) -> None:
        """Drop half-open sessions and kept responses that are too many or too old."""
        unconfirmed, responses = self._unconfirmed, self._responses
        while unconfirmed:
            index, session = next(iter(unconfirmed.items()))
            if len(unconfirmed) <= MAX_UNCONFIRMED and session.opened_at > now - UNCONFIRMED_S:
                break
            del unconfirmed[index]
            self._sessions.pop(index, None)
        while responses:
            ephemeral, (made_at, _) = next(iter(responses.items()))
            if len(responses) <= MAX_RESPONSES and made_at > now - RESPONSES_S:
                break
            del responses[ephemeral]

    def _sessions_end(self, sessions: list[Session]) -> None:
        for session in sessions:
            self._sessions.pop(session.local_index, None)

    def _new_index(self) -> int:
        while True:
            index = self._rng.getrandbits(8 * INDEX_BYTES)
            if index not in self._sessions and self._asker.opening(index) is None:
                return index

    def _send(self, session: Session, message: bytes) -> None:
        if self.is_running:
            self._network.send(session.seal(message), session.contact.address)
