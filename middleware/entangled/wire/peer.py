"""Store the state of the other nodes: sessions, round trips, handshakes under way, and pending requests.

``Peers`` opens sessions and decides when to renew them; it does not interpret the messages that are sent in them.
"""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from types import MappingProxyType

from twisted.internet.interfaces import IDelayedCall, IReactorTime

from middleware.entangled.background import cancel
from middleware.entangled.contact import Contact
from middleware.entangled.identity import derive_exchange_key
from middleware.entangled.listeners import Listeners
from middleware.entangled.network.network import Address, Network, is_relayed
from middleware.entangled.wire.admission_check import OPEN_ADMISSION, AdmissionCheck
from middleware.entangled.wire.congestion import BACKOFF_FACTOR, INITIAL_TIMEOUT_S, MAX_TIMEOUT_S, LossRate, RoundTrip
from middleware.entangled.wire.session import INDEX_BYTES, Credentials, HandshakeFields, InitiatorHandshake, Session

UNKNOWN_PEER_TIMEOUT_S = 0.3
MAX_TRIES = 4
MIN_CHECK_TRIES = 2
"""The minimum number of INITs to a peer that may have lost its session with this node."""
MAX_PEERS = 4096
MAX_HANDSHAKES = 1024
MAX_SESSIONS = 3
HANDSHAKE_S = 1.5
MAX_TARGETS = 12
"""The number of addresses to which one handshake sends its INIT."""
MAX_INITIAL_TIMEOUT_S = 0.5
"""The maximum timeout of the first try to an unknown peer, in seconds."""
HELP_AFTER_S = 0.2
"""Seconds after which a handshake without an answer makes this node ask other nodes for a path to a distant peer."""
PUNCH_INTERVAL_S, FAST_PUNCHES = 0.1, 16
"""The seconds between two INITs during hole punching, and the number of INITs after which the interval grows."""
LIVE_S = 3.0
SESSION_SILENCE_S = 105.0
"""In a large network, a peer is assumed to still have the session if it was silent for at most this number of seconds.
This is shorter than the time after which a session is forgotten; the margin covers the difference between the last
datagrams of both sides."""
SESSION_LIFE_S = 120.0
"""The age in seconds at which a session is replaced when something is sent in it."""
RENEWAL_DELAY_S = 30.0
"""The seconds by which the peer with the higher key delays the replacement of a session, so that normally only the peer
with the lower key replaces it."""
SESSION_END_S = 180.0
"""The age in seconds at which the keys of a session are deleted."""
SWEEP_S = 1.0
# The maximum number of datagrams in one session: far below the limit of ChaCha20-Poly1305 under one key, which is 2**62
# datagrams of this size.
SESSION_DATAGRAMS = 2**32


NO_NUMBERS: Mapping[int, None] = MappingProxyType({})
"""An empty table that is shared by all peers without pending requests; most peers have none."""


def _add_number(numbers: Mapping[int, None], number: int) -> Mapping[int, None]:
    if not isinstance(numbers, dict):
        return {number: None}
    numbers[number] = None
    return numbers


def _remove_number(numbers: Mapping[int, None], number: int) -> Mapping[int, None]:
    if isinstance(numbers, dict):
        numbers.pop(number, None)
    return numbers or NO_NUMBERS


@dataclass(slots=True, eq=False)
class OutgoingHandshake:
    """A handshake of this node that waits for its RESP.

    The first INIT was sent to ``address``.  ``cookies`` maps every address to which the INIT is sent to the cookie that
    was requested there.  The session is needed within ``timeout_s`` seconds.  Until the time ``held_until`` other nodes
    help with hole punching, and the handshake continues regardless of the number of its tries.  ``has_request``: a
    request waits for the handshake; if none does, this node started the handshake to admit the peer or to find a better
    path.  A handshake that ``is_waiting`` sends nothing more and waits for a late RESP.
    """

    initiator: InitiatorHandshake
    peer: Peer
    address: Address
    started_at: float
    cookies: dict[Address, bytes]
    timeout_s: float
    tries: int = 0
    punches: int = 0
    held_until: float = 0.0
    has_request: bool = True
    is_waiting: bool = False
    timer: IDelayedCall | None = None
    help_timer: IDelayedCall | None = None


@dataclass(slots=True, eq=False)
class Peer:
    """One peer, identified by its public key; ``contact`` has the address of the latest request to it.

    ``own`` are this node's credentials under the team secret that the peer uses, if that is not the newest secret.
    """

    contact: Contact
    sessions: tuple[Session, ...] = ()
    handshake: OutgoingHandshake | None = None
    round_trip: RoundTrip = field(default_factory=RoundTrip)
    notifications: tuple[bytes, ...] = ()
    requests: Mapping[int, None] = field(
        default_factory=lambda: NO_NUMBERS
    )  # the ids of pending requests to this peer, in order
    queue: Mapping[int, None] = field(
        default_factory=lambda: NO_NUMBERS
    )  # the pending requests that have not been sent yet
    in_flight: int = 0
    credentials: Credentials | None = None

    @property
    def public(self) -> bytes:
        """The public key that identifies the peer."""
        return self.contact.public

    @property
    def session(self) -> Session | None:
        """The session that is used for sending: the newest one."""
        return self.sessions[-1] if self.sessions else None

    @property
    def direct_session(self) -> Session | None:
        """The newest session that is not relayed."""
        return next((session for session in reversed(self.sessions) if not is_relayed(session.contact.address)), None)

    def oldest_request(self, number: int) -> int:
        """Return the id of the oldest pending request to this peer, or ``number`` if there is none."""
        return next(iter(self.requests), number)

    def add_request(self, number: int) -> None:
        """Record a request to this peer."""
        self.requests = _add_number(self.requests, number)

    def remove_request(self, number: int) -> None:
        """Record that no caller waits for the answer to a request any longer."""
        self.requests = _remove_number(self.requests, number)

    def enqueue(self, number: int) -> None:
        """Record that a request waits in the queue."""
        self.queue = _add_number(self.queue, number)

    def dequeue(self, number: int) -> None:
        """Record that a request left the queue."""
        self.queue = _remove_number(self.queue, number)

    @property
    def is_idle(self) -> bool:
        """Whether no request or handshake with this peer is pending."""
        return self.handshake is None and not self.requests


class Peers:
    """All peers of an endpoint, their ``sessions`` by index, and the outgoing handshakes of this node.

    ``ring`` are the credentials under the team's secrets, newest first; ``admission`` supplies the admission credential
    that this node sends.  ``on_handshake_failed`` is called with a handshake that got no answer to any of its tries.
    ``is_far`` returns whether other nodes may know a path to an address; ``on_slow_handshake`` is called with a
    handshake to such an address that gets no early answer.  ``on_established`` is called with each new session, and
    ``on_moved`` with a session in which a datagram arrived from a new address.

    ``overall_round_trip`` is the round trip to all peers together.  In a network that ``is_large`` it is also the
    estimate for unknown peers, because needless retransmissions to many unknown peers would be expensive.  ``loss`` is
    the loss rate of incoming datagrams.
    """

    def __init__(
        self,
        ring: Sequence[Credentials],
        clock: IReactorTime,
        rng: random.Random,
        network: Network,
        counters: Counter[str],
        admission: AdmissionCheck = OPEN_ADMISSION,
    ) -> None:
        self.ring = ring
        self.admission = admission
        self.sessions: dict[int, Session] = {}
        self.on_handshake_failed = Listeners[[OutgoingHandshake]]()
        self.is_far: Callable[[Address], bool] = lambda address: False
        self.on_slow_handshake = Listeners[[OutgoingHandshake]]()
        self.on_established = Listeners[[Session]]()
        self.on_moved = Listeners[[Session]]()
        self._clock = clock
        self._rng = rng
        self._network = network
        self._counters = counters
        self.overall_round_trip = RoundTrip()
        self.loss = LossRate()
        self.is_large = False
        self._peers: dict[bytes, Peer] = {}
        self._handshakes: dict[int, OutgoingHandshake] = {}
        self._timestamp = 0
        self._sweeper: IDelayedCall | None = None
        self._by_mac: dict[bytes, OutgoingHandshake] = {}

    def get(self, public: bytes) -> Peer | None:
        """Return the peer with that key, if it is known."""
        return self._peers.get(public)

    def make_contact(self, public: bytes, address: Address) -> Contact:
        """Return the contact with that key and address, reusing an existing object."""
        peer = self._peers.get(public)
        if peer is not None and peer.contact.address == address:
            return peer.contact
        return Contact(public, address)

    def find_session(self, public: bytes) -> Session | None:
        """Return the newest session with the peer of that key."""
        peer = self._peers.get(public)
        return peer.session if peer is not None else None

    def find_direct_session(self, public: bytes) -> Session | None:
        """Return the newest session with the peer of that key that is not relayed."""
        peer = self._peers.get(public)
        return peer.direct_session if peer is not None else None

    def get_or_create(self, contact: Contact) -> Peer:
        """Return the peer of that contact, creating it if needed; raise ``ValueError`` if its public key is invalid."""
        peer = self._peers.get(contact.public)
        if peer is not None:
            # the least recently used peer is first
            self._peers[contact.public] = self._peers.pop(contact.public)
            peer.contact = contact
            return peer
        derive_exchange_key(contact.public)  # raises ValueError for an invalid key
        peer = self._peers[contact.public] = Peer(contact)
        if self.is_large:
            peer.round_trip = RoundTrip(self.initial_timeout)
        if len(self._peers) > MAX_PEERS:
            idle = next((other for other in self._peers.values() if other.is_idle and other is not peer), None)
            if idle is not None:
                del self._peers[idle.public]
                self._delete_sessions(idle.sessions)
        return peer

    @property
    def initial_timeout(self) -> float:
        """The timeout of the first request to an unknown peer in seconds, estimated from all peers."""
        return max(INITIAL_TIMEOUT_S, min(self.overall_round_trip.timeout, MAX_INITIAL_TIMEOUT_S))

    def find_timeout(self, public: bytes) -> float:
        """Return the retransmission timeout of a peer in seconds."""
        peer = self._peers.get(public)
        return peer.round_trip.timeout if peer is not None and peer.round_trip.is_measured else UNKNOWN_PEER_TIMEOUT_S

    @property
    def tries(self) -> int:
        """The number of tries of a request or handshake: the usual number, or more if the loss rate is high."""
        return max(MAX_TRIES, self.loss.tries)

    def retry_interval(self, round_trip: RoundTrip, tries: int, within: float) -> float:
        """Return the seconds between the try number ``tries`` and the next one.

        ``within`` is the time in seconds in which the request should succeed.  Up to the usual number of tries, each
        interval is longer than the previous interval.  At a high loss rate the intervals are shortened to fit the
        required number of tries, but not below the time within which most answers arrive.  For a peer without
        measurements, the mean over all peers is used as the estimate.
        """
        wait = round_trip.timeout * BACKOFF_FACTOR ** (min(tries, MAX_TRIES) - 1)
        likely = round_trip.most if round_trip.is_measured else self.overall_round_trip.mean
        return wait if likely is None else min(wait, max(likely, within / self.loss.tries))

    def find_usable_session(self, peer: Peer) -> Session | None:
        """Return the session to send in, or None; drop the peer's sessions that reached their datagram limit.

        If an idle peer may have forgotten its sessions, these are also dropped.
        """
        session = peer.session
        if session is None:
            return None
        if (peer.is_idle and not self.has_live_session(peer)) or session.sent > 2 * SESSION_DATAGRAMS:
            self._delete_sessions(peer.sessions)
            peer.sessions = ()
            return None
        return session

    def renew_if_old(self, session: Session) -> None:
        """Open a successor of a session that is old or near its datagram limit; call this before sending in it.

        The one of the two peers that has the lower key opens the successor first, so that there are not two successors.
        """
        public = session.contact.public
        life = SESSION_LIFE_S if self.ring[0].public < public else SESSION_LIFE_S + RENEWAL_DELAY_S
        if self._clock.seconds() - session.opened_at < life and session.sent < SESSION_DATAGRAMS:
            return
        peer = self._peers.get(public)
        if peer is not None and session in (peer.session, peer.direct_session):
            self.open(peer, session.contact.address)

    def has_live_session(self, peer: Peer) -> bool:
        """Return whether there is a session that a running peer has not forgotten yet.

        In a large network, each node forgets the sessions with a silent peer without notification, at a time that the
        peer does not know.  Datagrams that the peer sends later in such a session are lost.
        """
        since = self._clock.seconds() - SESSION_SILENCE_S if self.is_large else float("-inf")
        return any(session.last_received_at >= since for session in peer.sessions)

    def add_session(self, session: Session) -> Peer:
        """Use a session for sending to its peer from now on; return the peer."""
        peer = self.get_or_create(session.contact)
        is_carried = is_relayed(session.contact.address)
        newest = peer.session
        if is_carried and newest is not None and self._is_live_and_direct(newest):
            # a relayed session does not replace a live direct one
            peer.sessions = (*peer.sessions[:-1], session, newest)
        else:
            peer.sessions = (*peer.sessions, session)
        if len(peer.sessions) > MAX_SESSIONS:
            self._delete_sessions(peer.sessions[:1])
            peer.sessions = peer.sessions[1:]
        if peer.handshake is not None and peer.handshake.punches and not is_carried:
            self.close(peer.handshake)  # during hole punching, the handshake of the peer succeeded first
        if self._sweeper is None:
            self._sweep()
        self.on_established(session)
        return peer

    def _sweep(self) -> None:
        """Delete the sessions that reached their maximum age, and schedule the next sweep."""
        self._sweeper, now = None, self._clock.seconds()
        while self.sessions:  # the sessions are in the order in which they were opened
            oldest = next(iter(self.sessions.values()))
            left = oldest.opened_at + SESSION_END_S - now
            if left > 0:
                self._sweeper = self._clock.callLater(max(left, SWEEP_S), self._sweep)
                return
            self.drop(oldest)

    def measure_confirmation(self, session: Session) -> None:
        """Measure the round trip of a peer from the RESP to the confirmation of the session.

        Without this measurement the first request to the peer would be retransmitted too early, and a long path would
        be mistaken for a restart of the peer.
        """
        peer = self.get_or_create(session.contact)
        if not peer.round_trip.is_measured:
            self.record_answer(peer, 1, self._clock.seconds() - session.opened_at)

    def record_answer(self, peer: Peer, tries: int, seconds: float) -> None:
        """Update the estimates with an answer that arrived ``seconds`` after the first of ``tries`` tries."""
        for round_trip in (peer.round_trip, self.overall_round_trip):
            if tries == 1:
                round_trip.add_sample(seconds)
            else:
                round_trip.lengthen(seconds)

    def tries_before_check(self, peer: Peer) -> int:
        """Return the number of unanswered tries after which a peer may have lost the session.

        If the round trip is unknown or the loss rate is high, a single unanswered try is not sufficient evidence.
        """
        return 1 if peer.round_trip.is_measured and self.loss.tries == 1 else 2

    def record_move(self, session: Session) -> None:
        """Record that a peer's newest datagram came from a different address than the previous one."""
        peer = self._peers.get(session.contact.public)
        if peer is not None:
            for other in peer.sessions:
                other.contact = session.contact
            self.on_moved(session)

    def rekey(self, ring: Sequence[Credentials]) -> None:
        """Open handshakes under the first of ``ring`` from now on."""
        self.ring = ring
        for peer in self._peers.values():
            peer.credentials = None

    def record_credentials(self, contact: Contact, own: Credentials) -> None:
        """Record under which of several secrets ``contact`` answered."""
        if len(self.ring) > 1:
            with suppress(ValueError):  # the key that the contact sent is invalid
                self.get_or_create(contact).credentials = own

    def evict(self, peer: Peer) -> None:
        """Forget the sessions and the handshake with a peer."""
        if peer.handshake is not None:
            self.close(peer.handshake)
        self._delete_sessions(peer.sessions)
        peer.sessions = ()
        peer.notifications = ()

    def forget_silent(self, before: float) -> list[bytes]:
        """Forget the idle peers from which nothing was received since ``before``; return their keys."""
        silent = [
            peer
            for peer in self._peers.values()
            if peer.is_idle
            and not peer.notifications
            and all(session.last_received_at < before for session in peer.sessions)
        ]
        for peer in silent:
            self._delete_sessions(peer.sessions)
            del self._peers[peer.public]
        return [peer.public for peer in silent]

    def drop(self, session: Session) -> None:
        """Forget one session."""
        self._delete_sessions([session])
        peer = self._peers.get(session.contact.public)
        if peer is not None:
            peer.sessions = tuple(other for other in peer.sessions if other is not session)

    @property
    def hello(self) -> HandshakeFields:
        """The handshake fields of this node."""
        admission = self.admission
        return HandshakeFields(admission.incarnation, admission.own_pass, admission.max_pass_bytes)

    def new_index(self) -> int:
        """Return an unused session index; never 0."""
        while True:
            index = self._rng.getrandbits(8 * INDEX_BYTES)
            if index and index not in self.sessions and index not in self._handshakes:
                return index

    def stop(self) -> None:
        """Cancel every handshake and forget every peer."""
        for opening in self._handshakes.values():
            cancel(opening.timer)
            cancel(opening.help_timer)
        cancel(self._sweeper)
        self._sweeper = None
        self._handshakes.clear()
        self._by_mac.clear()
        self._peers.clear()
        self.sessions.clear()

    # -- outgoing handshakes ----------------------------------------------------------------------------------------

    def open(
        self,
        peer: Peer,
        address: Address,
        early_message: bytes = b"",
        is_wanted: bool = True,
        within: float = HANDSHAKE_S,
    ) -> bool:
        """Start a handshake unless one with this peer is under way; return False if there are too many handshakes.

        ``early_message`` is a message for the INIT; it is omitted if it does not fit.  ``within`` is the time in
        seconds in which the session is needed.
        """
        if peer.handshake is not None:
            if is_wanted and not peer.handshake.has_request:
                peer.handshake.has_request = True
                peer.handshake.cookies.setdefault(address, b"")
                self._schedule_help(peer.handshake, address)
            if peer.handshake.is_waiting and not peer.sessions:
                cancel(peer.handshake.timer)
                self._send_init(peer.handshake, is_asked=True)
            return True
        if len(self._handshakes) >= MAX_HANDSHAKES:
            self._counters["crowded"] += 1
            return False
        own, hello = peer.credentials or self.ring[0], self.hello
        early_message = early_message if len(early_message) <= hello.max_early_bytes else b""
        now = self._clock.seconds()
        self._timestamp = max(self._timestamp + 1, int(now * 1e6))
        secret, index = self._rng.randbytes(32), self.new_index()
        invitation = InitiatorHandshake(
            own, derive_exchange_key(peer.public), secret, index, early_message, hello, self._timestamp
        )
        opening = OutgoingHandshake(invitation, peer, address, now, {address: b""}, within)
        self._handshakes[invitation.local_index] = self._by_mac[invitation.mac] = peer.handshake = opening
        opening.has_request = is_wanted
        if is_wanted:
            self._schedule_help(opening, address)
        self._send_init(opening)
        return True

    def extend(self, opening: OutgoingHandshake, until: float) -> None:
        """Continue a handshake until ``until``, because other nodes help; a past time restores the usual limit."""
        if opening.peer.handshake is opening:
            opening.held_until = until

    def punch(self, opening: OutgoingHandshake, addresses: Iterable[Address]) -> None:
        """Send the INIT also to further addresses, immediately and then at short intervals (hole punching)."""
        if opening.peer.handshake is not opening:
            return
        for address in addresses:
            if len(opening.cookies) < MAX_TARGETS:
                opening.cookies.setdefault(address, b"")
        opening.punches = 1
        cancel(opening.timer)
        self._send_init(opening)

    def find_handshake(self, index: int) -> OutgoingHandshake | None:
        """Return the outgoing handshake with this session index."""
        return self._handshakes.get(index)

    def find_handshake_by_mac(self, mac: bytes) -> OutgoingHandshake | None:
        """Return the outgoing handshake with this hash in its INIT."""
        return self._by_mac.get(mac)

    def resend_with_cookie(self, opening: OutgoingHandshake, cookie: bytes, source: Address) -> None:
        """Resend the INIT immediately with the cookie that the responder requested at that address."""
        if opening.cookies.get(source) != cookie:
            opening.cookies[source] = cookie
            self._network.send(opening.initiator.make_init(cookie), source)

    def finish(self, opening: OutgoingHandshake) -> None:
        """Close an outgoing handshake that got its RESP, and measure its round trip."""
        self.close(opening)
        if not opening.punches:  # otherwise the measured time would include hole punching
            tries = opening.tries + any(opening.cookies.values())  # a responder that requested a cookie got two INITs
            self.record_answer(opening.peer, tries, self._clock.seconds() - opening.started_at)

    def _send_init(self, opening: OutgoingHandshake, is_asked: bool = False) -> None:
        """Send an INIT and schedule the next one, unless enough INITs were sent.

        ``is_asked``: this INIT is sent because a new request waits for the session.
        """
        left = opening.started_at + HANDSHAKE_S - self._clock.seconds()
        opening.is_waiting = not is_asked and opening.tries > 0 and self._has_sent_enough(opening)
        is_over = left <= 0 if opening.is_waiting else opening.tries >= self.tries
        if is_over and self._clock.seconds() >= opening.held_until:
            self.close(opening)
            if len(self.ring) > 1:  # the peer may lack the newest secret, or may have deleted an older secret
                ring = list(self.ring)
                tried = ring.index(opening.initiator.credentials) if opening.initiator.credentials in ring else -1
                opening.peer.credentials = ring[(tried + 1) % len(ring)]
            self.on_handshake_failed(opening)
            return
        if opening.is_waiting:
            opening.timer = self._clock.callLater(left, self._send_init, opening)
            return
        opening.tries += 1
        for address, cookie in opening.cookies.items():
            self._network.send(opening.initiator.make_init(cookie), address)
        if opening.punches:
            opening.punches += 1
            wait = min(PUNCH_INTERVAL_S * BACKOFF_FACTOR ** max(0, opening.punches - FAST_PUNCHES), MAX_TIMEOUT_S)
        else:
            wait = self._next_interval(opening)
        opening.timer = self._clock.callLater(wait, self._send_init, opening)

    def _has_sent_enough(self, opening: OutgoingHandshake) -> bool:
        """Return whether enough INITs, the most expensive datagrams, were sent.

        A handshake for requests is repeated until no request waits.  If a session exists already, the handshake only
        replaces it or checks whether the peer lost it.  In this case the requests are also sent in the session, and the
        next request would retry the handshake.
        """
        peer = opening.peer
        if not opening.has_request or opening.punches or opening.held_until:
            return False
        if peer.sessions:
            return opening.tries >= max(MIN_CHECK_TRIES, self.loss.tries)
        return not (peer.requests or peer.notifications)

    def _next_interval(self, opening: OutgoingHandshake) -> float:
        round_trip = opening.peer.round_trip
        wait = self.retry_interval(round_trip, opening.tries, opening.timeout_s)
        if opening.tries == self.tries and not round_trip.is_measured:
            # The round trip of this peer has not been measured, so the peer may be distant instead of unreachable.
            wait = max(wait, opening.started_at + HANDSHAKE_S - self._clock.seconds())
        return wait

    def _schedule_help(self, opening: OutgoingHandshake, address: Address) -> None:
        if self.is_far(address):
            wait = 0.0 if is_relayed(address) else HELP_AFTER_S
            opening.help_timer = self._clock.callLater(wait, self.on_slow_handshake, opening)

    def _is_live_and_direct(self, session: Session) -> bool:
        is_lively = self._clock.seconds() - session.last_received_at < LIVE_S
        return is_lively and not is_relayed(session.contact.address)

    def close(self, opening: OutgoingHandshake) -> None:
        """Forget an outgoing handshake."""
        cancel(opening.timer)
        cancel(opening.help_timer)
        self._handshakes.pop(opening.initiator.local_index, None)
        self._by_mac.pop(opening.initiator.mac, None)
        opening.peer.handshake = None

    def _delete_sessions(self, sessions: Iterable[Session]) -> None:
        for session in sessions:
            self.sessions.pop(session.local_index, None)
