"""Endpoint: a node's end of the wire; asks, answers and tells in sealed datagrams.

It sorts what arrives, keeps the table of sessions, and drops and counts what does not open.  How questions are repeated
stands in ``asker``, how they are answered in ``answerer``; ``docs/protocol.md`` has every byte.
"""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Callable, Mapping
from typing import Any

from twisted.internet import defer
from twisted.internet.defer import Deferred
from twisted.internet.interfaces import IReactorTime

from middleware.entangled.errors import Forged, Malformed, NotRunning
from middleware.entangled.identity import Identity
from middleware.entangled.kademlia.contact import Contact
from middleware.entangled.network.network import MAX_DATAGRAM, Address, Network
from middleware.entangled.wire.answerer import Answerer
from middleware.entangled.wire.asker import PATIENCE, Asker
from middleware.entangled.wire.courier import Courier
from middleware.entangled.wire.greeting import COOKIE, HERE, WHO, Cookies, Greeter
from middleware.entangled.wire.message import (
    PART,
    RECEIPT,
    Answer,
    Cancel,
    Failure,
    Key,
    Question,
    Told,
    decoded,
)
from middleware.entangled.wire.method import ErrorCodes, Method
from middleware.entangled.wire.peer import Peers
from middleware.entangled.wire.session import (
    DATA,
    INIT,
    OVERHEAD,
    RESP,
    RESP_LEAST,
    Acceptance,
    Credentials,
    HalfOpen,
    Session,
    derived_key,
    index_of,
    is_init_of_team,
)


class Endpoint:
    """The wire of one node.

    ``team_key`` (32 bytes) is the secret of the team: who lacks it can neither read nor be answered.  ``rng`` makes the
    ephemeral keys, so outside of simulations it must be ``random.SystemRandom``, and in them no node may be given dice
    that fall as those of its former life did.

    ``on_contact`` is called when a peer has proved its key and its address: it answered us, or confirmed the session
    that it opened.  ``counters`` counts every datagram that was dropped, by its reason: oversized, unknown,
    malformed, forged, replayed, stale (no such session), repeated, misdirected, unasked, late, cancelled, abandoned
    (a parcel that stopped half-way); and what was put off or refused for want of room (crowded, busy).
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
        self._codes = ErrorCodes()
        self._peers = Peers(self._own, clock, rng, network, self.counters)
        self._courier = Courier(
            clock,
            self._send_to,
            self._on_parcel,
            self._peers.wait_for,
            lambda number, public: self._asker.is_asked(number, public),
            lambda number, public: self._asker.progressed(number, public),
            self.counters,
        )
        self._answerer = Answerer(clock, self._send, self._courier, self._codes, self.counters)
        self._asker = Asker(clock, rng, self._peers, self._courier, self._send, self._codes, self.counters)
        greet_key, cookie_key = derived_key(team_key, b"greet"), derived_key(team_key, b"cookie")
        self._greeter = Greeter(identity.public, greet_key, cookie_key, self._peers, network, clock, rng, self.counters)
        self._cookies = Cookies(cookie_key, rng)
        self._sessions = self._peers.sessions
        self._half_open = HalfOpen(self._sessions)
        self._receivers: dict[int, Callable[[bytes, Address], None]] = {
            DATA: self._on_data,
            INIT: self._on_init,
            RESP: self._on_resp,
            WHO: self._greeter.on_who,
            HERE: self._greeter.on_here,
            COOKIE: self._greeter.on_cookie,
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
        self._half_open.clear()
        error = NotRunning("the endpoint was stopped")
        self._greeter.stop(error)
        self._asker.stop(error)
        self._courier.stop()
        self._peers.stop()

    def expose(self, name: str, answer: Callable[..., object], changes: bool = False, idempotent: bool = False) -> None:
        """Let peers call ``answer(peer, *arguments)`` under ``name``.

        It returns something that msgpack can hold (``MAX_MESSAGE`` at most), a Deferred or a coroutine of it, or raises
        ``Refused`` or an exception that both sides named by ``expose_error``: the asker gets it with its text.
        Arguments that do not fit the function's parameters and plain annotations are refused before it runs; other
        exceptions are logged, and the asker gets ``Refused("internal error")``.  With ``changes`` it runs only in an
        established session, and at most once for each question; a repeated one is given the answer of the first.  Say
        ``idempotent`` as well where a second run does no harm: then nothing need be kept of the first.

        When the asker gives up or its time is over, a Deferred or coroutine is cancelled.  A function with a
        keyword-only parameter ``deadline`` gets that moment, in seconds of this node's clock (infinite where none).
        """
        self._answerer.methods[name] = Method(name, answer, changes, idempotent)

    def expose_error(self, kind: type[Exception], code: str) -> None:
        """Let exceptions of ``kind`` cross the wire, both ways, under ``code``, made again from their text alone.

        What has no name here arrives as ``Refused`` with its ``code``.  Raises ``ValueError`` for a code that is taken
        or cannot be one.
        """
        self._codes.add(kind, code)

    def ask(
        self, contact: Contact, method: str, *arguments: object, timeout: float | None = None, changes: bool = False
    ) -> Deferred[Any]:
        """Ask a peer, and try again until it answers, at most four times and for ``timeout`` seconds.

        Question and answer may have ``MAX_MESSAGE`` bytes; what does not fit into a datagram goes as a parcel.  Of many
        questions to one peer the later ones wait for their turn.  Without ``timeout`` the answer has 1.5 s, counted
        from that turn and anew at each sign that a parcel makes progress.  With a longer one the tries are spread over
        it, for methods that take their time.  Say ``changes`` where the method changes
        something: such a question waits for the session, others ride in the handshake.

        Fails with ``NoAnswer``, ``Refused`` (the peer's text), an exception named by ``expose_error``, ``TooLarge``,
        ``Crowded``, ``NotRunning``, or with the ``TypeError`` of arguments that msgpack cannot hold.  When it is
        cancelled, the peer is told and cancels its work.
        """
        if not self.is_running:
            return defer.fail(NotRunning("the endpoint is not running; start it first"))
        return self._asker.ask(contact, method, arguments, timeout, changes)

    def tell(self, contact: Contact, method: str, *arguments: object) -> None:
        """Call a peer's method once, without answer and without a second try; raises ``TooLarge`` and ``NotRunning``.

        It must fit into one datagram.  Opens a session first where there is none.
        """
        if not self.is_running:
            raise NotRunning("the endpoint is not running; start it first")
        self._asker.tell(contact, method, arguments)

    def is_met(self, contact: Contact) -> bool:
        """Whether there is a session with ``contact``, so that a question needs one round trip and no handshake."""
        peer = self._peers.known(contact.public)
        return peer is not None and peer.session is not None

    def round_trip(self, contact: Contact) -> float | None:
        """How long an answer of ``contact`` takes, in seconds, or None where nobody was timed yet."""
        peer = self._peers.known(contact.public)
        return None if peer is None else peer.round_trip.mean

    @property
    def traffic(self) -> Mapping[str, int]:
        """What the network underneath counts (``sent``, ``received``, ...); empty where it counts nothing."""
        return dict(getattr(self._network, "counters", {}))

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
            self._peers.moved(session)
        if not session.is_confirmed:
            self._half_open.confirm(session)
            self._established(session, is_owed=False)
            self.on_contact(session.contact)
        if not data or not self.is_running:
            return
        if data[0] == PART:
            self._courier.on_part(session, data)
        elif data[0] == RECEIPT:
            self._courier.on_receipt(session, data)
        else:
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
        elif isinstance(message, Cancel):
            self._answerer.cancel(message, session.contact.public)
        else:
            self._resolve(message, session.contact)

    def _on_parcel(self, session: Session, key: Key, data: bytes) -> None:
        """Take a message that arrived in parts; it must be what its parcel said."""
        try:
            message = decoded(data)
        except Malformed:
            self.counters["malformed"] += 1
            return
        if isinstance(message, Question) and key == (False, message.id):
            self._answerer.answer(message, session, is_bulky=True)
        elif isinstance(message, Answer | Failure) and key == (True, message.id):
            self._resolve(message, session.contact)
        else:
            self.counters["malformed"] += 1

    def _established(self, session: Session, is_owed: bool) -> None:
        peer = self._peers.established(session)
        self._courier.restart(peer.public)
        self._asker.established(peer, session, is_owed)

    def _resolve(self, message: Answer | Failure, contact: Contact) -> None:
        if self._asker.is_asked(message.id, contact.public):
            self.on_contact(contact)
        self._asker.resolve(message, contact.public)

    def _on_init(self, datagram: bytes, source: Address) -> None:
        if not is_init_of_team(self._own, datagram):
            self.counters["forged"] += 1
            return
        now = self._clock.seconds()
        if not self._cookies.is_lawful(datagram, source, now):
            self.counters["forged"] += 1
            return
        known = self._half_open.response(datagram, now)
        if known is not None:  # the RESP was lost, or somebody plays a recording: neither costs a key exchange
            self.counters["repeated"] += 1
            self._network.send(known, source)
            return
        if not self._cookies.admits(datagram, source, now):
            self.counters["crowded"] += 1
            self._network.send(self._cookies.reply(datagram, source, now), source)
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
        index = self._peers.new_index()
        response, keys = acceptance.accept(index, answer)
        session = Session(contact, index, acceptance.remote_index, keys, now, is_confirmed=False)
        self._half_open.add(session, datagram, response, now)
        self._network.send(response, source)

    def _on_resp(self, datagram: bytes, source: Address) -> None:
        if len(datagram) < RESP_LEAST:
            self.counters["malformed"] += 1
            return
        opening = self._peers.opening(index_of(datagram))
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
        self._peers.accepted(opening)
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
            self._established(session, is_owed=True)

    def _send(self, session: Session, message: bytes) -> None:
        if self.is_running:
            self._network.send(session.seal(message), session.contact.address)

    def _send_to(self, public: bytes, message: bytes) -> None:
        """Send on the newest session with a peer; where there is none the message is lost, as datagrams may be."""
        peer = self._peers.known(public)
        if peer is not None and peer.session is not None:
            self._send(peer.session, message)
