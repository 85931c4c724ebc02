"""Send and answer requests of one node in encrypted datagrams.

The endpoint dispatches received datagrams, keeps the table of sessions, and drops and counts invalid datagrams.
``asker`` retransmits requests, ``answerer`` answers them; ``docs/reference/wire-protocol.md`` specifies every byte.
"""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Callable, Mapping
from typing import Any

from twisted.internet import defer
from twisted.internet.defer import Deferred
from twisted.internet.interfaces import IReactorTime
from twisted.logger import Logger

from middleware.entangled.bounded import keep
from middleware.entangled.contact import Contact
from middleware.entangled.errors import Forged, Malformed, NotAdmitted, NotRunning
from middleware.entangled.identity import Identity
from middleware.entangled.listeners import Listeners
from middleware.entangled.network.network import MAX_CARRIED, MAX_DATAGRAM, Address, Network
from middleware.entangled.wire.answerer import Answerer
from middleware.entangled.wire.asker import PATIENCE, Asker
from middleware.entangled.wire.courier import Courier
from middleware.entangled.wire.door import (
    DOUBLED,
    FOREIGN,
    OPEN,
    REVOKED,
    ROLE,
    SUPERSEDED,
    Door,
    Life,
    Lives,
    Noted,
    Stamps,
    checked_secrets,
    is_refusal,
    meaning,
)
from middleware.entangled.wire.greeting import COOKIE, HERE, WHO, Cookies, Greeter
from middleware.entangled.wire.hail import ECHO, HAIL, Echo, Echoer, Hailer
from middleware.entangled.wire.message import (
    PART,
    RECEIPT,
    REFUSAL,
    Answer,
    Cancel,
    Failure,
    Key,
    Question,
    Told,
    decoded,
)
from middleware.entangled.wire.method import Method
from middleware.entangled.wire.peer import Peers
from middleware.entangled.wire.rebuff import Rebuffs, Side
from middleware.entangled.wire.session import (
    DATA,
    INIT,
    INIT_LEAST,
    OVERHEAD,
    RESP,
    RESP_LEAST,
    Acceptance,
    Credentials,
    HalfOpen,
    Session,
    index_of,
    is_init_of_team,
)

_REFUSAL = bytes([REFUSAL])
MAX_REFUSALS = 32

Inside = Callable[[Session, bytes, Address], None]
"""Takes the content of a DATA datagram: its session, the plaintext, and its source address."""


class Endpoint:
    """The wire protocol of one node.

    ``team_key`` (32 bytes) is the secret of the team: a node without it can neither decrypt nor cause an answer.
    ``rng`` generates the ephemeral keys, so outside of simulations it must be ``random.SystemRandom``; in simulations a
    restarted node must not repeat the numbers of its earlier incarnations.  ``door`` decides which nodes are admitted,
    and which methods a peer may call.

    ``on_contact`` is called when a peer has proved its key and its address, by an answer or by confirming a session
    that it opened; ``on_seen`` with a peer and this node's address as the peer sees it; ``on_refused`` when a peer
    rejects this node, and ``on_refusing`` when this node rejects an authenticated peer, each with the refusal code;
    ``on_let_go`` with the key of a peer that was forgotten after a long silence.

    ``counters`` counts dropped datagrams by reason: oversized, unknown, malformed, forged, replayed, stale (no such
    session), repeated, misdirected, unasked, late, cancelled, abandoned (an incomplete fragmented message); requests
    and messages rejected for lack of room (crowded, busy); and rejected nodes and calls (refused).
    """

    _log = Logger()

    def __init__(
        self,
        identity: Identity,
        team_key: bytes,
        network: Network,
        clock: IReactorTime,
        rng: random.Random,
        door: Door = OPEN,
    ) -> None:
        self.door = door
        self.on_contact = Listeners[[Contact]]()
        self.on_seen = Listeners[[Contact, Address]]()
        self.on_refused = Listeners[[Contact, str]]()
        self.on_refusing = Listeners[[Contact, str]]()
        self.on_let_go = Listeners[[bytes]]()
        self.refusals: dict[bytes, tuple[Contact, str]] = {}
        """Peers that reject this node, by key, with the refusal code; the latest ``MAX_REFUSALS``."""
        self.rebuffs = Rebuffs()
        """Rejections of the last hour, in both directions."""
        self.counters: Counter[str] = Counter()
        self.is_running = False
        self._network = network
        self._clock = clock
        self._rng = rng
        self._identity = identity
        self._credentials = Credentials.of(identity, team_key)
        self._lives = Lives()
        self._stamps = Stamps()
        self._noted = Noted()
        self._peers = Peers([self._credentials], clock, rng, network, self.counters, door)
        self._courier = Courier(
            clock,
            self._send_to,
            self._on_parcel,
            self._peers.wait_for,
            lambda number, public: self._asker.is_asked(number, public),
            lambda number, public: self._asker.progressed(number, public),
            self.counters,
        )
        self._answerer = Answerer(clock, self._send, self._courier, self.counters, door.may, self._refuse_call)
        self._asker = Asker(clock, rng, self._peers, self._courier, self._send, self.counters)
        self.greeter = Greeter(identity.public, self._peers, network, clock, rng, self.counters)
        self._cookies = Cookies(self._credentials.cookie_key, rng)
        self.echoer = Echoer(self.post, clock, lambda: door.fingerprint)
        self.hailer = Hailer(self.post, clock, rng)
        self._sessions = self._peers.sessions
        self._half_open = HalfOpen(self._sessions)
        self._inside: dict[int, Inside] = {}
        self._receivers: dict[int, Callable[[bytes, Address], None]] = {
            DATA: self._on_data,
            INIT: self._on_init,
            RESP: self._on_resp,
            WHO: self.greeter.on_who,
            HERE: self.greeter.on_here,
            COOKIE: self.greeter.on_cookie,
            HAIL: lambda datagram, source: self._count(self.echoer.on_hail(datagram, source)),
            ECHO: lambda datagram, source: self._count(self.hailer.on_echo(datagram, source)),
        }

    @property
    def address(self) -> Address:
        """The address of the underlying network."""
        return self._network.address

    def start(self) -> None:
        """Open the network; raise ``PortInUse`` if the port is in use."""
        if not self.is_running:
            self._network.listen(self._received)
            self.is_running = True

    def stop(self) -> None:
        """Close the network, forget every session, cancel every timer; pending requests fail with ``NotRunning``."""
        if not self.is_running:
            return
        self.is_running = False
        self._network.close()
        self._answerer.clear()
        self._half_open.clear()
        error = NotRunning("the endpoint was stopped")
        self.greeter.stop(error)
        self.hailer.stop(error)
        self._asker.stop(error)
        self._courier.stop()
        self._peers.stop()

    def rekey(self, newest: bytes, *older: bytes) -> None:
        """Replace the secret of the team (32 bytes); existing sessions continue.

        This node opens handshakes under the ``newest`` secret.  While not all members have it, handshakes under the
        ``older`` ones are accepted too, and a peer that does not answer under one secret is retried under the next.
        Raises ``ValueError`` for an invalid secret.
        """
        secrets = checked_secrets([newest, *older])
        self._peers.rekey([Credentials.of(self._identity, secret) for secret in secrets])
        self._credentials = self._peers.ring[0]

    def evict(self, public: bytes, code: str = REVOKED) -> None:
        """Close the sessions with a peer: send it ``code``, and fail the requests to it with ``NotAdmitted``.

        The admission check must reject the peer from then on.
        """
        peer = self._peers.known(public)
        if peer is not None and peer.session is not None:
            self._refuse(peer.session, code)
        else:
            self._disconnect(public, f"{public.hex()[:16]} is rejected: {meaning(code)}", code)

    def route(self, kind: int, receiver: Callable[[bytes, Address], None]) -> None:
        """Pass datagrams with the first byte ``kind`` to ``receiver``; raise ``ValueError`` if the kind is taken."""
        if kind in self._receivers:
            raise ValueError(f"datagrams of kind {kind:#x} already have a receiver; use another kind")
        self._receivers[kind] = receiver

    def post(self, datagram: bytes, to: Address) -> None:
        """Send a datagram of a routed kind unencrypted; no effect while the endpoint is not running."""
        if self.is_running:
            self._network.send(datagram, to)

    def expose(
        self,
        name: str,
        answer: Callable[..., object],
        changes: bool = False,
        idempotent: bool = False,
        early: bool = False,
    ) -> None:
        """Let peers call ``answer(peer, *arguments)`` under ``name``.

        The function returns a value that msgpack can encode (at most ``MAX_MESSAGE`` bytes), a Deferred or a coroutine
        of one, or raises ``Refused``, which the requester receives with its code and text.  Arguments that do not match
        the function's parameters and plain annotations are rejected before it runs; other exceptions are logged, and
        the requester receives ``Refused("internal error")``.  The function runs only in an established session.  With
        ``changes`` it runs at most once per request, and a repeated request receives the first answer.  Also set
        ``idempotent`` if a second run does no harm: then no answer is kept.

        With ``early`` it may also run for a request inside an INIT, which saves a round trip.  An attacker may send a
        replayed INIT from a forged address, so an early method only reads, sends nothing, and returns its result, not a
        Deferred; ``ValueError`` if it ``changes`` something.

        A Deferred or coroutine is cancelled when the requester gives up or its timeout expires.  A function with a
        keyword-only parameter ``deadline`` receives that time, in seconds of this node's clock (infinite if there is
        none).
        """
        self._answerer.methods[name] = Method(name, answer, changes, idempotent, early)

    def route_inside(self, kind: int, receiver: Inside) -> None:
        """Pass messages in confirmed sessions with this first byte to ``receiver``.

        They do not change the address of their peer, because they may arrive by a path other than the usual one.
        """
        self._inside[kind] = receiver

    def send_inside(self, session: Session, plain: bytes, to: Address | None = None) -> None:
        """Seal ``plain`` for the peer of a session and send it to the peer's address, or to its address ``to``."""
        if self.is_running:
            self._network.send(self._sealed(session, plain), to or session.contact.address)

    @property
    def peers(self) -> Peers:
        """The state of the other nodes."""
        return self._peers

    def ask(
        self,
        contact: Contact,
        method: str,
        *arguments: object,
        timeout: float | None = None,
        changes: bool = False,
        is_light: bool = False,
    ) -> Deferred[Any]:
        """Send a request to a peer, with four tries (more at a high loss rate) within ``timeout`` seconds.

        Request and answer may have ``MAX_MESSAGE`` bytes; if larger than a datagram they are sent in fragments.  Of
        many requests to one peer the later ones wait in a queue.  The default timeout is 1.5 s, counted from the moment
        when the request leaves the queue and restarted by each acknowledged fragment.  With a longer ``timeout`` the
        tries are distributed over it, for slow methods.  Set ``changes`` if the method has side effects: such a request
        waits for the session, others ride in the handshake.  A request that ``is_light`` opens no new session while
        there is an old one, even if the peer is silent.

        Fails with ``NoAnswer``, ``Refused`` (the peer's code and text), ``TooLarge``, ``Crowded``, ``NotAdmitted``,
        ``NotRunning``, or with the ``TypeError`` of arguments that msgpack cannot encode.  Cancelling the Deferred also
        cancels the work at the peer.
        """
        if not self.is_running:
            return defer.fail(NotRunning("the endpoint is not running; start it first"))
        return self._asker.ask(contact, method, arguments, timeout, changes, is_light)

    def tell(self, contact: Contact, method: str, *arguments: object) -> None:
        """Send a notification: call a peer's method once, without an answer or retransmission.

        It must fit into one datagram.  Opens a session if there is none.  Raises ``TooLarge`` and ``NotRunning``.
        """
        if not self.is_running:
            raise NotRunning("the endpoint is not running; start it first")
        self._asker.tell(contact, method, arguments)

    def is_met(self, contact: Contact) -> bool:
        """Return whether there is a session with ``contact``; then a request needs one round trip and no handshake."""
        peer = self._peers.known(contact.public)
        return peer is not None and self._peers.is_in_touch(peer)

    def round_trip(self, contact: Contact) -> float | None:
        """Return the smoothed round trip to ``contact`` in seconds, or None if it was not measured."""
        peer = self._peers.known(contact.public)
        return None if peer is None else peer.round_trip.mean

    @property
    def traffic(self) -> Mapping[str, int]:
        """The counters of the underlying network (``sent``, ``received``, ...); empty if it has none."""
        return dict(getattr(self._network, "counters", {}))

    def greet(self, address: Address, timeout: float = PATIENCE) -> Deferred[Contact]:
        """Discover the contact at ``address``; fails with ``NoAnswer``.  The contact has not proved its key yet."""
        if not self.is_running:
            return defer.fail(NotRunning("the endpoint is not running; start it first"))
        return self.greeter.greet(address, timeout)

    def overhear(self, datagram: bytes, source: Address) -> None:
        """Process a datagram that did not arrive at the node's own port; answers are sent from that port."""
        if self.is_running:
            self._received(datagram, source)

    def let_go(self, seconds: float) -> None:
        """Forget the peers that sent nothing for ``seconds``, unless a request to them is pending.

        The other side does the same, or discovers it with its next unanswered request; either side opens a new session
        when it needs one.
        """
        now = self._clock.seconds()
        self._half_open.sweep(now)
        self._answerer.tidy(now)
        for public in self._peers.let_go(now - seconds):
            self._courier.let_go(public)
            self.on_let_go(public)

    def reopen(self, contact: Contact) -> None:
        """Open a session at the contact's address even if there is one elsewhere; the newest session is used."""
        if self.is_running:
            self._peers.open(self._peers.peer(contact), contact.address)

    def hail(self, address: Address, timeout: float = PATIENCE) -> Deferred[Echo]:
        """Probe ``address`` for a node of any team; fails with ``NoAnswer``.  The reply is not authenticated."""
        if not self.is_running:
            return defer.fail(NotRunning("the endpoint is not running; start it first"))
        return self.hailer.hail(address, timeout)

    def _count(self, reason: str) -> None:
        if reason:
            self.counters[reason] += 1

    def _received(self, datagram: bytes, source: Address) -> None:
        if len(datagram) > MAX_DATAGRAM and not (datagram[0] == DATA and len(datagram) <= MAX_CARRIED):
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
            data, ahead = session.open(datagram)
        except Forged:
            self.counters["forged"] += 1
            return
        self._peers.loss.arrived(ahead)
        session.heard_at = self._clock.seconds()
        if data[:1] == _REFUSAL:
            self._on_refusal(session, data[1:])
            return
        if session.is_over:
            self._refuse(session, SUPERSEDED)
            return
        inside = self._inside.get(data[0]) if data else None
        if ahead > 0 and source != session.contact.address and inside is None:
            session.contact = Contact(session.contact.public, source)
            self._peers.moved(session)
        if not session.is_confirmed:
            code = self._find_refusal(session.contact.public, session.shown, session.life, self.door.admit)
            session.shown = b""
            if code:  # two nodes with one identity opened a session at once, or the membership list is full
                self._refuse(session, code)
                return
            self._half_open.confirm(session)
            self._established(session, is_owed=False)
            self._peers.confirmed(session)
            self.on_contact(session.contact)
        if not data or not self.is_running:
            return
        if inside is not None:
            inside(session, data, source)
        elif len(datagram) > MAX_DATAGRAM:
            self.counters["oversized"] += 1
        elif data[0] == PART:
            self._courier.on_part(session, data)
        elif data[0] == RECEIPT:
            self._courier.on_receipt(session, data)
        else:
            self._on_message(data, session)

    def _on_message(self, data: bytes, session: Session) -> None:
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
        """Process a message that arrived in fragments; reject one with a kind or id other than its fragments say."""
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
        self.refusals.pop(session.contact.public, None)
        peer = self._peers.established(session)
        if self._lives.met(session.contact.public, session.life):
            for other in peer.sessions:
                other.is_over = other.life != session.life
        self._courier.restart(peer.public)
        self._asker.established(peer, session, is_owed)

    def _resolve(self, message: Answer | Failure, contact: Contact) -> None:
        if self._asker.is_asked(message.id, contact.public):
            self.on_contact(contact)
        self._asker.resolve(message, contact.public)

    def _on_init(self, datagram: bytes, source: Address) -> None:
        own = None
        if INIT_LEAST + self.door.room <= len(datagram) <= MAX_DATAGRAM:
            for own in self._peers.ring:  # inlined, because a forged INIT must cost no more than this
                if is_init_of_team(own, datagram):
                    break
            else:
                own = None
        if own is None:
            self.counters["forged"] += 1
            return
        now = self._clock.seconds()
        if not self._cookies.is_lawful(datagram, source, now):
            self.counters["forged"] += 1
            return
        known = self._half_open.response(datagram, now)
        if known is not None:  # the RESP was lost, or the INIT is a replay: neither costs a key exchange
            self.counters["repeated"] += 1
            self._network.send(known, source)
            return
        if not self._cookies.admits(datagram, source, now):
            self.counters["crowded"] += 1
            self._network.send(self._cookies.reply(datagram, source, now, own.cookie_key), source)
            return
        try:
            acceptance = Acceptance(own, datagram, self._rng.randbytes(32))
        except Forged:
            self.counters["forged"] += 1
            return
        response = self._response_to(acceptance, source, now)
        if response and self.is_running:
            self._half_open.answered(datagram, response, now)
            self._network.send(response, source)

    def _response_to(self, acceptance: Acceptance, source: Address, now: float) -> bytes:
        """Return the RESP for an INIT that proved its sender's key; nothing for a replay or a malformed message."""
        contact, hello = self._peers.contact(acceptance.public, source), self._peers.hello
        code = self._find_refusal(contact.public, acceptance.shown, acceptance.life, self.door.judge)
        if code:  # no further effects: the INIT may be a replay, with a pass that was replaced since
            self.counters["refused"] += 1
            self._log_refusal(contact, code)
            if code not in (DOUBLED, SUPERSEDED):  # a replay must not make operators look for a copied identity
                self._record_rejection("we", contact, code)
            return acceptance.refuse(code, source, hello.life)
        if not self._stamps.take(contact.public, acceptance.life, acceptance.stamp):
            self.counters["replayed"] += 1
            return b""
        try:
            rider = decoded(acceptance.rider) if acceptance.rider else None
        except Malformed:
            self.counters["malformed"] += 1
            return b""
        answer = b""
        if isinstance(rider, Question):
            answer = self._answerer.ride(rider, contact, acceptance.answer_room(hello))
        if not self.is_running:
            return b""  # the method stopped the endpoint
        index = self._peers.new_index()
        response, keys = acceptance.accept(index, answer, source, hello)
        session = Session(contact, index, acceptance.remote_index, keys, now, is_confirmed=False, life=acceptance.life)
        session.shown = acceptance.shown
        self._half_open.add(session, now)
        return response

    def _on_resp(self, datagram: bytes, source: Address) -> None:
        if len(datagram) < RESP_LEAST:
            self.counters["malformed"] += 1
            return
        opening = self._peers.opening(index_of(datagram))
        if opening is None:
            self.counters["stale"] += 1
            return
        if source not in opening.doors:
            self.counters["misdirected"] += 1
            return
        try:
            reply = opening.invitation.accepted(datagram)
        except Forged:
            self.counters["forged"] += 1
            return
        contact = self._peers.contact(opening.peer.public, source)
        index = opening.invitation.local_index
        self._peers.accepted(opening)
        if reply.refusal:
            self._record_refusal(contact, reply.refusal)
            return
        session = Session(
            contact, index, reply.remote_index, reply.keys, self._clock.seconds(), is_confirmed=True, life=reply.life
        )
        code = self._find_refusal(contact.public, reply.shown, reply.life, self.door.admit)
        if code:
            self._refuse(session, code)
            return
        self._sessions[index] = session
        self.on_contact(contact)
        if reply.seen is not None:
            self.on_seen(contact, reply.seen)
        message: object = None
        if reply.message:
            try:
                message = decoded(reply.message)
            except Malformed:
                self.counters["malformed"] += 1
        if isinstance(message, Answer | Failure):
            self._asker.resolve(message, contact.public)
        if self.is_running:
            self._established(session, is_owed=True)

    # -- admission --------------------------------------------------------------------------------------------------

    def _find_refusal(self, public: bytes, shown: bytes, life: Life, judge: Callable[[bytes, bytes], str]) -> str:
        if len(shown) > self.door.room:
            return FOREIGN
        return self._lives.judge(public, life) or judge(public, shown)

    def _refuse(self, session: Session, code: str) -> None:
        """Notify a peer on ``session`` that it is rejected, and close its sessions."""
        contact = session.contact
        self._send(session, _REFUSAL + code.encode("ascii"))
        self.counters["refused"] += 1
        self._log_refusal(contact, code)
        self._record_rejection("we", contact, code)
        self.on_refusing(contact, code)
        self._half_open.forget(session)
        self._peers.drop(session)
        peer = self._peers.known(contact.public)
        if code not in (DOUBLED, SUPERSEDED) or peer is None or not peer.sessions:
            self._disconnect(contact.public, f"{contact.address} is rejected: {meaning(code)}", code)

    def _on_refusal(self, session: Session, said: bytes) -> None:
        """Process the notification of a peer that it rejects this node."""
        code = said.decode("ascii", errors="replace")
        if not is_refusal(code):
            self.counters["malformed"] += 1
            return
        self._peers.drop(session)
        self._record_refusal(session.contact, code)

    def _record_refusal(self, contact: Contact, code: str) -> None:
        text = f"{contact.address} rejects this node: {meaning(code)}"
        self._record_rejection("they", contact, code)
        if self._is_new_to_log(contact.public, code, True):
            self._log.warn("{text}", text=text, code=code)
        self._disconnect(contact.public, text, code)
        keep(self.refusals, contact.public, (contact, code), MAX_REFUSALS)
        self.on_refused(contact, code)

    def _disconnect(self, public: bytes, text: str, code: str) -> None:
        """Forget the sessions and messages of a peer, and fail the requests to it."""
        self._half_open.drop(public)
        self._answerer.evict(public)
        peer = self._peers.known(public)
        if peer is not None:
            self._peers.evict(peer)
            self._asker.refused(peer, lambda: NotAdmitted(text, code))
        self._courier.evict(public)

    def _record_rejection(self, side: Side, contact: Contact, code: str) -> None:
        self.rebuffs.met(contact.public, str(contact.address), side, code, meaning(code), self._clock.seconds())

    def _log_refusal(self, contact: Contact, code: str) -> None:
        if self._is_new_to_log(contact.public, code):
            who, why = contact.public.hex()[:16], meaning(code)
            self._log.warn("{who} at {at} is rejected: {why}", who=who, at=contact.address, why=why, code=code)

    def _is_new_to_log(self, *what: object) -> bool:
        return self._noted.is_new(self._clock.seconds(), *what)

    def _refuse_call(self, peer: Contact, method: str) -> None:
        self._record_rejection("call", peer, ROLE)
        if self._is_new_to_log(peer.public, ROLE):
            who, why = peer.public.hex()[:16], meaning(ROLE)
            self._log.warn(
                "{who} at {at} may not call {method}: {why}",
                who=who,
                at=peer.address,
                method=method,
                why=why,
                code=ROLE,
            )

    # -- sending ----------------------------------------------------------------------------------------------------

    def _send(self, session: Session, message: bytes) -> None:
        if self.is_running:
            self._network.send(self._sealed(session, message), session.contact.address)

    def _sealed(self, session: Session, message: bytes) -> bytes:
        self._peers.renew(session)
        return session.seal(message)

    def _send_to(self, public: bytes, message: bytes) -> None:
        """Send in the newest session with a peer; without a session the message is lost, as any datagram may be."""
        peer = self._peers.known(public)
        if peer is not None and peer.session is not None:
            self._send(peer.session, message)
