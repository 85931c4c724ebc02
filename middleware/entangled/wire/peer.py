"""Peer: what an endpoint remembers of the others: sessions, round trips, handshakes under way, what is asked of them.

``Peers`` opens sessions and says when to open another one; what is sent on them is not its affair.
"""

from __future__ import annotations

import random
from collections import Counter, OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field

from twisted.internet.interfaces import IDelayedCall, IReactorTime

from middleware.entangled.identity import exchange_key
from middleware.entangled.kademlia.contact import Contact
from middleware.entangled.network.network import Address, Network
from middleware.entangled.wire.congestion import BACK_OFF, RoundTrip
from middleware.entangled.wire.session import INDEX_BYTES, MAX_RIDER, Credentials, Invitation, Session

STRANGER_WAIT = 0.3
MAX_TRIES = 4
MAX_PEERS = 4096
MAX_OPENINGS = 1024
MAX_SESSIONS = 3
OPENING_S = 1.5
SESSION_LIFE_S = 3600.0
SESSION_END_S = SESSION_LIFE_S + 600.0
# Far below what ChaCha20-Poly1305 allows under one key (2**62 datagrams of this size).
SESSION_DATAGRAMS = 2**32


@dataclass(slots=True, eq=False)
class Opening:
    """A handshake of ours that waits for its RESP."""

    invitation: Invitation
    peer: Peer
    address: Address
    started_at: float
    cookie: bytes = b""
    tries: int = 0
    timer: IDelayedCall | None = None


@dataclass(slots=True, eq=False)
class Peer:
    """One peer, known by its public key; ``static`` is the X25519 key that follows from it."""

    public: bytes
    static: bytes
    sessions: list[Session] = field(default_factory=list)
    opening: Opening | None = None
    round_trip: RoundTrip = field(default_factory=RoundTrip)
    tells: list[bytes] = field(default_factory=list)
    inquiries: dict[int, None] = field(default_factory=dict)  # the numbers of what is asked of it, in order
    queue: dict[int, None] = field(default_factory=dict)  # those of them that have not been sent yet
    in_flight: int = 0

    @property
    def session(self) -> Session | None:
        """The session that is used for sending: the newest one."""
        return self.sessions[-1] if self.sessions else None

    def oldest(self, number: int) -> int:
        """The oldest question that is asked of it; ``number`` where there is none."""
        return next(iter(self.inquiries), number)

    @property
    def is_idle(self) -> bool:
        """Whether nobody waits for anything from this peer."""
        return self.opening is None and not self.inquiries


class Peers:
    """All peers of an endpoint, ``sessions`` by their index, and the handshakes that we began.

    ``on_unheard`` is called with a handshake of ours that got no answer to any of its tries.
    """

    def __init__(
        self, own: Credentials, clock: IReactorTime, rng: random.Random, network: Network, counters: Counter[str]
    ) -> None:
        self.sessions: dict[int, Session] = {}
        self.on_unheard: Callable[[Opening], None] = lambda opening: None
        self._own = own
        self._clock = clock
        self._rng = rng
        self._network = network
        self._counters = counters
        self._peers: OrderedDict[bytes, Peer] = OrderedDict()
        self._openings: dict[int, Opening] = {}
        self._by_mac: dict[bytes, Opening] = {}

    def known(self, public: bytes) -> Peer | None:
        """The peer of that key, if anything is remembered of it."""
        return self._peers.get(public)

    def peer(self, contact: Contact) -> Peer:
        """The peer of that key, remembered from now on; raises ``ValueError`` where the key is none."""
        peer = self._peers.get(contact.public)
        if peer is not None:
            self._peers.move_to_end(contact.public)
            return peer
        peer = self._peers[contact.public] = Peer(contact.public, exchange_key(contact.public))
        if len(self._peers) > MAX_PEERS:
            idle = next((other for other in self._peers.values() if other.is_idle and other is not peer), None)
            if idle is not None:
                del self._peers[idle.public]
                self._end(idle.sessions)
        return peer

    def wait_for(self, public: bytes) -> float:
        """How long to wait for a sign of a peer before trying again, in seconds."""
        peer = self._peers.get(public)
        return peer.round_trip.wait if peer is not None and peer.round_trip.is_measured else STRANGER_WAIT

    def usable(self, peer: Peer) -> Session | None:
        """The session to send on; an old or worn one calls for its successor, a very old one is dropped."""
        session = peer.session
        if session is None:
            return None
        age = self._clock.seconds() - session.opened_at
        if age > SESSION_END_S or session.sent > 2 * SESSION_DATAGRAMS:
            self._end(peer.sessions)
            peer.sessions = []
            return None
        if age > SESSION_LIFE_S or session.sent > SESSION_DATAGRAMS:
            self.open(peer, session.contact.address)
        return session

    def established(self, session: Session) -> Peer:
        """Use a session for sending from now on; gives its peer."""
        peer = self.peer(session.contact)
        peer.sessions.append(session)
        if len(peer.sessions) > MAX_SESSIONS:
            self._end([peer.sessions.pop(0)])
        return peer

    def moved(self, session: Session) -> None:
        """Take note that a peer's newest datagram came from another address."""
        peer = self._peers.get(session.contact.public)
        if peer is not None:
            for other in peer.sessions:
                other.contact = session.contact

    def new_index(self) -> int:
        """A free index for a session."""
        while True:
            index = self._rng.getrandbits(8 * INDEX_BYTES)
            if index not in self.sessions and index not in self._openings:
                return index

    def stop(self) -> None:
        """Cancel every handshake and forget every peer."""
        for opening in self._openings.values():
            cancel(opening.timer)
        self._openings.clear()
        self._by_mac.clear()
        self._peers.clear()
        self.sessions.clear()

    # -- handshakes of ours -----------------------------------------------------------------------------------------

    def open(self, peer: Peer, address: Address, rider: bytes = b"") -> bool:
        """Open a session, unless that is under way; False where there are too many handshakes.

        ``rider`` is a message for its INIT; one that does not fit stays behind.
        """
        if peer.opening is not None:
            return True
        if len(self._openings) >= MAX_OPENINGS:
            self._counters["crowded"] += 1
            return False
        rider = rider if len(rider) <= MAX_RIDER else b""
        invitation = Invitation(self._own, peer.static, self._rng.randbytes(32), self.new_index(), rider)
        opening = Opening(invitation, peer, address, self._clock.seconds())
        self._openings[invitation.local_index] = self._by_mac[invitation.mac] = peer.opening = opening
        self._knock(opening)
        return True

    def opening(self, index: int) -> Opening | None:
        """The handshake of ours that has this session index."""
        return self._openings.get(index)

    def opening_of(self, mac: bytes) -> Opening | None:
        """The handshake of ours whose INIT has this hash."""
        return self._by_mac.get(mac)

    def paid(self, opening: Opening, cookie: bytes) -> None:
        """Send the INIT again at once, with the cookie that the responder asked for."""
        if opening.cookie != cookie:
            opening.cookie = cookie
            self._network.send(opening.invitation.datagram(cookie), opening.address)

    def accepted(self, opening: Opening) -> None:
        """Take note that a handshake of ours got its RESP."""
        self._close(opening)
        if opening.tries == 1 and not opening.cookie:
            opening.peer.round_trip.measured(self._clock.seconds() - opening.started_at)

    def _knock(self, opening: Opening) -> None:
        """Send an INIT, again if need be, until the tries are used up."""
        if opening.tries >= MAX_TRIES:
            self._close(opening)
            self.on_unheard(opening)
            return
        opening.tries += 1
        self._network.send(opening.invitation.datagram(opening.cookie), opening.address)
        round_trip = opening.peer.round_trip
        wait = round_trip.wait * BACK_OFF ** (opening.tries - 1)
        if opening.tries == MAX_TRIES and not round_trip.is_measured:
            # Nothing is known of this peer: it may be far away rather than gone.
            wait = max(wait, opening.started_at + OPENING_S - self._clock.seconds())
        opening.timer = self._clock.callLater(wait, self._knock, opening)

    def _close(self, opening: Opening) -> None:
        cancel(opening.timer)
        self._openings.pop(opening.invitation.local_index, None)
        self._by_mac.pop(opening.invitation.mac, None)
        opening.peer.opening = None

    def _end(self, sessions: list[Session]) -> None:
        for session in sessions:
            self.sessions.pop(session.local_index, None)


def cancel(timer: IDelayedCall | None) -> None:
    """Cancel a timer that may be none, or over."""
    if timer is not None and timer.active():
        timer.cancel()
