"""Send and answer requests of one node in encrypted datagrams.

The endpoint dispatches received datagrams, maintains the table of sessions, and drops and counts invalid datagrams.
``requester`` retransmits this node's requests, and ``dispatcher`` answers the requests of peers.
``docs/reference/wire-protocol.md`` specifies every byte.
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

from middleware.entangled.bounded import put_bounded
from middleware.entangled.contact import Contact
from middleware.entangled.errors import Forged, Malformed, NotAdmitted, NotRunning
from middleware.entangled.identity import Identity
from middleware.entangled.listeners import Listeners
from middleware.entangled.network.network import MAX_DATAGRAM_BYTES, MAX_RELAYED_BYTES, Address, Network
from middleware.entangled.wire.admission_check import (
    DOUBLED,
    FOREIGN,
    OPEN_ADMISSION,
    REVOKED,
    ROLE,
    SUPERSEDED,
    AdmissionCheck,
    Incarnation,
    Incarnations,
    InitTimestamps,
    LogLimiter,
    check_secrets,
    explain,
    is_refusal,
)
from middleware.entangled.wire.discovery import COOKIE, DISCOVERY, DISCOVERY_REPLY, CookieCheck, Discoverer
from middleware.entangled.wire.dispatcher import Dispatcher
from middleware.entangled.wire.fragmenter import Fragmenter
from middleware.entangled.wire.message import (
    PART,
    RECEIPT,
    REFUSAL,
    Answer,
    Cancel,
    Failure,
    MessageKey,
    Notification,
    Request,
    decode,
)
from middleware.entangled.wire.method import Method
from middleware.entangled.wire.peer import Peers
from middleware.entangled.wire.probe import PROBE, PROBE_REPLY, Prober, ProbeReply, ProbeResponder
from middleware.entangled.wire.rejection import Rejections, Side
from middleware.entangled.wire.requester import TIMEOUT_S, Requester
from middleware.entangled.wire.session import (
    DATA,
    INIT,
    MIN_INIT_BYTES,
    MIN_RESP_BYTES,
    OVERHEAD_BYTES,
    RESP,
    Credentials,
    HalfOpenSessions,
    ResponderHandshake,
    Session,
    is_init_of_team,
    read_index,
)

_REFUSAL = bytes([REFUSAL])
MAX_REJECTING_PEERS = 32

MessageReceiver = Callable[[Session, bytes, Address], None]
"""Called with the session, the plaintext and the source address of a DATA datagram."""


class Endpoint:
    """The wire protocol of one node.

    ``team_key`` (32 bytes) is the secret of the team: a node that lacks it can neither decrypt datagrams nor cause a
    reply.  ``rng`` generates the ephemeral keys, so outside of simulations it must be ``random.SystemRandom``.  In
    simulations a restarted node must not repeat the random numbers of its earlier incarnations.  ``admission`` decides
    which nodes are admitted, and which methods a peer may call.

    ``on_contact`` is called when a peer has proved its key and its address, by an answer or by confirming a session
    that the peer opened.  ``on_seen`` is called with a peer and this node's address as the peer sees it.
    ``on_rejected`` is called when a peer rejects this node, and ``on_rejecting`` when this node rejects an
    authenticated peer, each with the refusal code.  ``on_forgotten`` is called with the key of a peer that was
    forgotten after a long silence.

    ``counters`` counts dropped datagrams by reason: oversized, unknown, malformed, forged, replayed, stale (no such
    session), repeated, misdirected, unasked, late, cancelled, abandoned (an incomplete fragmented message).  It also
    counts requests and messages that were rejected because a buffer or table was full (crowded, busy), and rejected
    nodes and calls (refused).
    """

    _log = Logger()

    def __init__(
        self,
        identity: Identity,
        team_key: bytes,
        network: Network,
        clock: IReactorTime,
        rng: random.Random,
        admission: AdmissionCheck = OPEN_ADMISSION,
    ) -> None:
        self.admission = admission
        self.on_contact = Listeners[[Contact]]()
        self.on_seen = Listeners[[Contact, Address]]()
        self.on_rejected = Listeners[[Contact, str]]()
        self.on_rejecting = Listeners[[Contact, str]]()
        self.on_forgotten = Listeners[[bytes]]()
        self.refusals: dict[bytes, tuple[Contact, str]] = {}
        """The latest ``MAX_REJECTING_PEERS`` peers that reject this node, by key, with the refusal code."""
        self.rejections = Rejections()
        """Rejections of the last hour, in both directions."""
        self.counters: Counter[str] = Counter()
        self.is_running = False
        self._network = network
        self._clock = clock
        self._rng = rng
        self._identity = identity
        self._credentials = Credentials.derive(identity, team_key)
        self._incarnations = Incarnations()
        self._timestamps = InitTimestamps()
        self._log_limiter = LogLimiter()
        self._peers = Peers([self._credentials], clock, rng, network, self.counters, admission)
        self._fragmenter = Fragmenter(
            clock,
            self._send_to,
            self._on_fragmented_message,
            self._peers.find_timeout,
            lambda number, public: self._requester.is_pending(number, public),
            lambda number, public: self._requester.record_progress(number, public),
            self.counters,
        )
        self._dispatcher = Dispatcher(
            clock, self._send, self._fragmenter, self.counters, admission.may_call, self._record_refused_call
        )
        self._requester = Requester(clock, rng, self._peers, self._fragmenter, self._send, self.counters)
        self.discoverer = Discoverer(identity.public, self._peers, network, clock, rng, self.counters)
        self._cookies = CookieCheck(self._credentials.cookie_key, rng)
        self.probe_responder = ProbeResponder(self.send_datagram, clock, lambda: admission.fingerprint)
        self.prober = Prober(self.send_datagram, clock, rng)
        self._sessions = self._peers.sessions
        self._half_open = HalfOpenSessions(self._sessions)
        self._message_receivers: dict[int, MessageReceiver] = {}
        self._receivers: dict[int, Callable[[bytes, Address], None]] = {
            DATA: self._on_data,
            INIT: self._on_init,
            RESP: self._on_resp,
            DISCOVERY: self.discoverer.on_discovery,
            DISCOVERY_REPLY: self.discoverer.on_discovery_reply,
            COOKIE: self.discoverer.on_cookie,
            PROBE: lambda datagram, source: self._count(self.probe_responder.on_probe(datagram, source)),
            PROBE_REPLY: lambda datagram, source: self._count(self.prober.on_reply(datagram, source)),
        }

    @property
    def address(self) -> Address:
        """The address of the underlying network."""
        return self._network.address

    def start(self) -> None:
        """Open the network; raise ``PortInUse`` if the port is in use."""
        if not self.is_running:
            self._network.listen(self._on_datagram)
            self.is_running = True

    def stop(self) -> None:
        """Close the network, forget every session, cancel every timer; pending requests fail with ``NotRunning``."""
        if not self.is_running:
            return
        self.is_running = False
        self._network.close()
        self._dispatcher.clear()
        self._half_open.clear()
        error = NotRunning("the endpoint was stopped")
        self.discoverer.stop(error)
        self.prober.stop(error)
        self._requester.stop(error)
        self._fragmenter.stop()
        self._peers.stop()

    def replace_secrets(self, newest: bytes, *older: bytes) -> None:
        """Replace the secret of the team (32 bytes); existing sessions continue.

        This node opens handshakes under the ``newest`` secret.  Handshakes under the ``older`` secrets are also
        accepted, because some members may not have the newest secret yet.  If a peer does not answer under one secret,
        this node retries under the next secret.  Raises ``ValueError`` for an invalid secret.
        """
        secrets = check_secrets([newest, *older])
        self._peers.rekey([Credentials.derive(self._identity, secret) for secret in secrets])
        self._credentials = self._peers.ring[0]

    def evict(self, public: bytes, code: str = REVOKED) -> None:
        """Close the sessions with a peer: send it ``code``, and fail the requests to it with ``NotAdmitted``.

        From this call on, the admission check must reject the peer.
        """
        peer = self._peers.get(public)
        if peer is not None and peer.session is not None:
            self._reject(peer.session, code)
        else:
            self._disconnect(public, f"{public.hex()[:16]} is rejected: {explain(code)}", code)

    def route(self, kind: int, receiver: Callable[[bytes, Address], None]) -> None:
        """Pass datagrams with the first byte ``kind`` to ``receiver``; raise ``ValueError`` if ``kind`` is in use."""
        if kind in self._receivers:
            raise ValueError(f"datagrams of kind {kind:#x} already have a receiver; use another kind")
        self._receivers[kind] = receiver

    def send_datagram(self, datagram: bytes, to: Address) -> None:
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

        The function returns a value that msgpack can encode (at most ``MAX_MESSAGE_BYTES`` bytes), or a Deferred or
        coroutine with such a result.  If it raises ``Refused``, the requester receives the code and text of the
        exception.  Arguments that do not match the function's parameters and plain annotations are rejected before it
        runs; other exceptions are logged, and the requester receives ``Refused("internal error")``.  The function runs
        only in an established session.  With ``changes`` the function runs at most once per request, and a repeated
        request receives the first answer.  Also set ``idempotent`` if a second run does no harm: then the answer is not
        stored.

        With ``early`` the function may also run for a request inside an INIT, which saves a round trip.  An attacker
        may send a replayed INIT from a forged address.  Therefore an early method must only read state, send nothing,
        and return its result immediately instead of a Deferred.  ``early`` together with ``changes`` raises
        ``ValueError``.

        A Deferred or coroutine is cancelled when the requester gives up or its timeout expires.  A function with a
        keyword-only parameter ``deadline`` receives the time at which the timeout expires, in seconds of this node's
        clock (infinite if there is no timeout).
        """
        self._dispatcher.methods[name] = Method(name, answer, changes, idempotent, early)

    def route_message(self, kind: int, receiver: MessageReceiver) -> None:
        """Pass messages in confirmed sessions with this first byte to ``receiver``.

        Such messages do not change the recorded address of their peer, because they may arrive by an unusual path.
        """
        self._message_receivers[kind] = receiver

    def send_sealed(self, session: Session, plain: bytes, to: Address | None = None) -> None:
        """Encrypt ``plain`` in a session and send it to the address ``to`` (None: the peer's latest address)."""
        if self.is_running:
            self._network.send(self._seal(session, plain), to or session.contact.address)

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

        Request and answer may have ``MAX_MESSAGE_BYTES`` bytes each; a message larger than a datagram is sent in
        fragments.  If many requests to one peer are pending, further requests wait in a queue.  The default timeout is
        1.5 s, counted from the moment when the request leaves the queue and restarted by each acknowledged fragment.
        If a longer ``timeout`` is given, for a slow method, the tries are distributed over this time.  Set ``changes``
        if the method has side effects: such a request waits for the session, whereas other requests are sent inside the
        handshake.  A request that ``is_light`` opens no new session if there is an old one, even if the peer is silent.

        Fails with ``NoAnswer``, ``Refused`` (the peer's code and text), ``TooLarge``, ``Crowded``, ``NotAdmitted``,
        ``NotRunning``, or with the ``TypeError`` of arguments that msgpack cannot encode.  Cancelling the Deferred also
        cancels the work at the peer.
        """
        if not self.is_running:
            return defer.fail(NotRunning("the endpoint is not running; start it first"))
        return self._requester.ask(contact, method, arguments, timeout, changes, is_light)

    def notify(self, contact: Contact, method: str, *arguments: object) -> None:
        """Send a notification: call a peer's method once, without an answer or retransmission.

        The notification must fit into one datagram.  This method opens a session if there is none.  Raises ``TooLarge``
        and ``NotRunning``.
        """
        if not self.is_running:
            raise NotRunning("the endpoint is not running; start it first")
        self._requester.notify(contact, method, arguments)

    def has_session(self, contact: Contact) -> bool:
        """Return whether there is a session with ``contact``; if so, a request needs no handshake."""
        peer = self._peers.get(contact.public)
        return peer is not None and self._peers.has_live_session(peer)

    def round_trip(self, contact: Contact) -> float | None:
        """Return the smoothed round trip to ``contact`` in seconds, or None if it was not measured."""
        peer = self._peers.get(contact.public)
        return None if peer is None else peer.round_trip.mean

    @property
    def traffic(self) -> Mapping[str, int]:
        """The counters of the underlying network (``sent``, ``received``, ...); empty if the network does not count."""
        return dict(getattr(self._network, "counters", {}))

    def discover(self, address: Address, timeout: float = TIMEOUT_S) -> Deferred[Contact]:
        """Discover the contact at ``address``; fails with ``NoAnswer``.  The contact has not proved its key yet."""
        if not self.is_running:
            return defer.fail(NotRunning("the endpoint is not running; start it first"))
        return self.discoverer.discover(address, timeout)

    def process_datagram(self, datagram: bytes, source: Address) -> None:
        """Process a datagram that did not arrive at the node's usual port; answers are sent from the usual port."""
        if self.is_running:
            self._on_datagram(datagram, source)

    def forget_silent(self, seconds: float) -> None:
        """Forget the peers that sent nothing for ``seconds``, unless a request to them is pending.

        The peer forgets the session after the same time, or detects by an unanswered request that this node has
        forgotten it.  Either side opens a new session when it needs one.
        """
        now = self._clock.seconds()
        self._half_open.sweep(now)
        self._dispatcher.delete_full_limiters(now)
        for public in self._peers.forget_silent(now - seconds):
            self._fragmenter.forget_flow(public)
            self.on_forgotten(public)

    def reopen(self, contact: Contact) -> None:
        """Open a session at the contact's address even if one at another address exists; the newest session is used."""
        if self.is_running:
            self._peers.open(self._peers.get_or_create(contact), contact.address)

    def probe(self, address: Address, timeout: float = TIMEOUT_S) -> Deferred[ProbeReply]:
        """Probe ``address`` for a node of any team; fails with ``NoAnswer``.  The reply is not authenticated."""
        if not self.is_running:
            return defer.fail(NotRunning("the endpoint is not running; start it first"))
        return self.prober.probe(address, timeout)

    def _count(self, reason: str) -> None:
        if reason:
            self.counters[reason] += 1

    def _on_datagram(self, datagram: bytes, source: Address) -> None:
        if len(datagram) > MAX_DATAGRAM_BYTES and not (datagram[0] == DATA and len(datagram) <= MAX_RELAYED_BYTES):
            self.counters["oversized"] += 1
            return
        receiver = self._receivers.get(datagram[0]) if datagram else None
        if receiver is None:
            self.counters["unknown"] += 1
        elif self.is_running:
            receiver(datagram, source)

    def _on_data(self, datagram: bytes, source: Address) -> None:
        if len(datagram) < OVERHEAD_BYTES:
            self.counters["malformed"] += 1
            return
        session = self._sessions.get(read_index(datagram))
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
        self._peers.loss.record_arrival(ahead)
        session.last_received_at = self._clock.seconds()
        if data[:1] == _REFUSAL:
            self._on_refusal(session, data[1:])
            return
        if session.is_superseded:
            self._reject(session, SUPERSEDED)
            return
        inside = self._message_receivers.get(data[0]) if data else None
        if ahead > 0 and source != session.contact.address and inside is None:
            session.contact = Contact(session.contact.public, source)
            self._peers.record_move(session)
        if not session.is_confirmed:
            code = self._find_refusal(
                session.contact.public, session.peer_pass, session.incarnation, self.admission.admit
            )
            session.peer_pass = b""
            if code:  # two nodes with one identity opened a session at the same time, or the membership list is full
                self._reject(session, code)
                return
            self._half_open.confirm(session)
            self._add_session(session, is_owed=False)
            self._peers.measure_confirmation(session)
            self.on_contact(session.contact)
        if not data or not self.is_running:
            return
        if inside is not None:
            inside(session, data, source)
        elif len(datagram) > MAX_DATAGRAM_BYTES:
            self.counters["oversized"] += 1
        elif data[0] == PART:
            self._fragmenter.on_fragment(session, data)
        elif data[0] == RECEIPT:
            self._fragmenter.on_receipt(session, data)
        else:
            self._on_message(data, session)

    def _on_message(self, data: bytes, session: Session) -> None:
        try:
            message = decode(data)
        except Malformed:
            self.counters["malformed"] += 1
            return
        if isinstance(message, Request):
            self._dispatcher.dispatch(message, session)
        elif isinstance(message, Notification):
            self._dispatcher.run_notification(message, session.contact)
        elif isinstance(message, Cancel):
            self._dispatcher.cancel(message, session.contact.public)
        else:
            self._resolve(message, session.contact)

    def _on_fragmented_message(self, session: Session, key: MessageKey, data: bytes) -> None:
        """Process a message that arrived in fragments; reject it if its kind or id differs from its fragments."""
        try:
            message = decode(data)
        except Malformed:
            self.counters["malformed"] += 1
            return
        if isinstance(message, Request) and key == (False, message.id):
            self._dispatcher.dispatch(message, session, is_bulky=True)
        elif isinstance(message, Answer | Failure) and key == (True, message.id):
            self._resolve(message, session.contact)
        else:
            self.counters["malformed"] += 1

    def _add_session(self, session: Session, is_owed: bool) -> None:
        self.refusals.pop(session.contact.public, None)
        peer = self._peers.add_session(session)
        if self._incarnations.record(session.contact.public, session.incarnation):
            for other in peer.sessions:
                other.is_superseded = other.incarnation != session.incarnation
        self._fragmenter.restart(peer.public)
        self._requester.send_waiting(peer, session, is_owed)

    def _resolve(self, message: Answer | Failure, contact: Contact) -> None:
        if self._requester.is_pending(message.id, contact.public):
            self.on_contact(contact)
        self._requester.resolve(message, contact.public)

    def _on_init(self, datagram: bytes, source: Address) -> None:
        own = None
        if MIN_INIT_BYTES + self.admission.max_pass_bytes <= len(datagram) <= MAX_DATAGRAM_BYTES:
            for own in self._peers.ring:  # inlined to make the rejection of a forged INIT as cheap as possible
                if is_init_of_team(own, datagram):
                    break
            else:
                own = None
        if own is None:
            self.counters["forged"] += 1
            return
        now = self._clock.seconds()
        if not self._cookies.is_valid(datagram, source, now):
            self.counters["forged"] += 1
            return
        known = self._half_open.find_response(datagram, now)
        if known is not None:  # the RESP was lost, or the INIT is a replay: in both cases no key exchange is needed
            self.counters["repeated"] += 1
            self._network.send(known, source)
            return
        if not self._cookies.admits(datagram, source, now):
            self.counters["crowded"] += 1
            self._network.send(self._cookies.pack_cookie(datagram, source, now, own.cookie_key), source)
            return
        try:
            acceptance = ResponderHandshake(own, datagram, self._rng.randbytes(32))
        except Forged:
            self.counters["forged"] += 1
            return
        response = self._make_response(acceptance, source, now)
        if response and self.is_running:
            self._half_open.store_response(datagram, response, now)
            self._network.send(response, source)

    def _make_response(self, acceptance: ResponderHandshake, source: Address, now: float) -> bytes:
        """Return the RESP for an INIT that proved its sender's key; nothing for a replay or a malformed message."""
        contact, hello = self._peers.make_contact(acceptance.public, source), self._peers.hello
        code = self._find_refusal(
            contact.public, acceptance.peer_pass, acceptance.incarnation, self.admission.find_refusal
        )
        if code:  # no further effects: the INIT may be a replay with an outdated admission credential
            self.counters["refused"] += 1
            self._log_rejection(contact, code)
            if code not in (DOUBLED, SUPERSEDED):  # a replay must not cause a report of a copied identity
                self._record_rejection("we", contact, code)
            return acceptance.refuse(code, source, hello.incarnation)
        if not self._timestamps.accept(contact.public, acceptance.incarnation, acceptance.timestamp):
            self.counters["replayed"] += 1
            return b""
        try:
            early_message = decode(acceptance.early_message) if acceptance.early_message else None
        except Malformed:
            self.counters["malformed"] += 1
            return b""
        answer = b""
        if isinstance(early_message, Request):
            answer = self._dispatcher.answer_early(early_message, contact, acceptance.max_answer_bytes(hello))
        if not self.is_running:
            return b""  # the method that ran has stopped the endpoint
        index = self._peers.new_index()
        response, keys = acceptance.accept(index, answer, source, hello)
        session = Session(
            contact, index, acceptance.remote_index, keys, now, is_confirmed=False, incarnation=acceptance.incarnation
        )
        session.peer_pass = acceptance.peer_pass
        self._half_open.add(session, now)
        return response

    def _on_resp(self, datagram: bytes, source: Address) -> None:
        if len(datagram) < MIN_RESP_BYTES:
            self.counters["malformed"] += 1
            return
        opening = self._peers.find_handshake(read_index(datagram))
        if opening is None:
            self.counters["stale"] += 1
            return
        if source not in opening.cookies:
            self.counters["misdirected"] += 1
            return
        try:
            reply = opening.initiator.read_response(datagram)
        except Forged:
            self.counters["forged"] += 1
            return
        contact = self._peers.make_contact(opening.peer.public, source)
        index = opening.initiator.local_index
        self._peers.finish(opening)
        if reply.refusal:
            self._handle_refusal(contact, reply.refusal)
            return
        session = Session(
            contact,
            index,
            reply.remote_index,
            reply.keys,
            self._clock.seconds(),
            is_confirmed=True,
            incarnation=reply.incarnation,
        )
        code = self._find_refusal(contact.public, reply.peer_pass, reply.incarnation, self.admission.admit)
        if code:
            self._reject(session, code)
            return
        self._sessions[index] = session
        self.on_contact(contact)
        if reply.observed_address is not None:
            self.on_seen(contact, reply.observed_address)
        message: object = None
        if reply.message:
            try:
                message = decode(reply.message)
            except Malformed:
                self.counters["malformed"] += 1
        if isinstance(message, Answer | Failure):
            self._requester.resolve(message, contact.public)
        if self.is_running:
            self._add_session(session, is_owed=True)

    # -- admission --------------------------------------------------------------------------------------------------

    def _find_refusal(
        self, public: bytes, peer_pass: bytes, incarnation: Incarnation, judge: Callable[[bytes, bytes], str]
    ) -> str:
        if len(peer_pass) > self.admission.max_pass_bytes:
            return FOREIGN
        return self._incarnations.find_refusal(public, incarnation) or judge(public, peer_pass)

    def _reject(self, session: Session, code: str) -> None:
        """Notify the peer of ``session`` that it is rejected, and close its sessions."""
        contact = session.contact
        self._send(session, _REFUSAL + code.encode("ascii"))
        self.counters["refused"] += 1
        self._log_rejection(contact, code)
        self._record_rejection("we", contact, code)
        self.on_rejecting(contact, code)
        self._half_open.forget(session)
        self._peers.drop(session)
        peer = self._peers.get(contact.public)
        if code not in (DOUBLED, SUPERSEDED) or peer is None or not peer.sessions:
            self._disconnect(contact.public, f"{contact.address} is rejected: {explain(code)}", code)

    def _on_refusal(self, session: Session, reported: bytes) -> None:
        """Process the notification of a peer that it rejects this node."""
        code = reported.decode("ascii", errors="replace")
        if not is_refusal(code):
            self.counters["malformed"] += 1
            return
        self._peers.drop(session)
        self._handle_refusal(session.contact, code)

    def _handle_refusal(self, contact: Contact, code: str) -> None:
        text = f"{contact.address} rejects this node: {explain(code)}"
        self._record_rejection("they", contact, code)
        if self._should_log(contact.public, code, True):
            self._log.warn("{text}", text=text, code=code)
        self._disconnect(contact.public, text, code)
        put_bounded(self.refusals, contact.public, (contact, code), MAX_REJECTING_PEERS)
        self.on_rejected(contact, code)

    def _disconnect(self, public: bytes, text: str, code: str) -> None:
        """Forget the sessions and messages of a peer, and fail the requests to it."""
        self._half_open.forget_peer(public)
        self._dispatcher.evict(public)
        peer = self._peers.get(public)
        if peer is not None:
            self._peers.evict(peer)
            self._requester.fail_requests(peer, lambda: NotAdmitted(text, code))
        self._fragmenter.evict(public)

    def _record_rejection(self, side: Side, contact: Contact, code: str) -> None:
        self.rejections.record(contact.public, str(contact.address), side, code, explain(code), self._clock.seconds())

    def _log_rejection(self, contact: Contact, code: str) -> None:
        if self._should_log(contact.public, code):
            who, why = contact.public.hex()[:16], explain(code)
            self._log.warn("{who} at {at} is rejected: {why}", who=who, at=contact.address, why=why, code=code)

    def _should_log(self, *what: object) -> bool:
        return self._log_limiter.should_log(self._clock.seconds(), *what)

    def _record_refused_call(self, peer: Contact, method: str) -> None:
        self._record_rejection("call", peer, ROLE)
        if self._should_log(peer.public, ROLE):
            who, why = peer.public.hex()[:16], explain(ROLE)
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
            self._network.send(self._seal(session, message), session.contact.address)

    def _seal(self, session: Session, message: bytes) -> bytes:
        self._peers.renew_if_old(session)
        return session.seal(message)

    def _send_to(self, public: bytes, message: bytes) -> None:
        """Send a message in the newest session with a peer; drop the message if there is no session."""
        peer = self._peers.get(public)
        if peer is not None and peer.session is not None:
            self._send(peer.session, message)
