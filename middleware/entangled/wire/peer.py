"""Peer: what an endpoint remembers of the others: sessions, round trips, handshakes under way, what is asked of them.

``Peers`` opens sessions and says when to open another one; what is sent on them is not its affair.
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
from middleware.entangled.identity import exchange_key
from middleware.entangled.listeners import Listeners
from middleware.entangled.network.network import Address, Network, is_relayed
from middleware.entangled.wire.congestion import BACK_OFF, FIRST_GUESS, LONGEST, Loss, RoundTrip
from middleware.entangled.wire.door import OPEN, Door
from middleware.entangled.wire.session import INDEX_BYTES, Credentials, Hello, Invitation, Session

STRANGER_WAIT = 0.3
MAX_TRIES = 4
DOUBTS = 2
"""How often, at least, an INIT goes to a peer that may have forgotten our session."""
MAX_PEERS = 4096
MAX_OPENINGS = 1024
MAX_SESSIONS = 3
OPENING_S = 1.5
MAX_DOORS = 12
"""Addresses at which one handshake knocks."""
MOST_GUESSED = 0.5
"""Seconds that a stranger is waited for at most, before it is asked again."""
HELP_S = 0.2
"""Seconds without an answer after which others are asked how a far peer is reached."""
KNOCK_S, KNOCKS = 0.1, 16
"""Seconds between knocks where others help, and for how many of them; then they become rarer."""
LIVELY_S = 3.0
IN_TOUCH = 105.0
"""Seconds of silence up to which the other side of a session surely has its end yet, in a wide network: less than those
after which it lets go of it, by more than can lie between what either of us heard last."""
SESSION_LIFE_S = 120.0
"""Age from which a session is succeeded by another one, when something is sent on it."""
SECOND_S = 30.0
"""Seconds by which the one of two peers that has the higher key leaves that to the other one."""
SESSION_END_S = 180.0
"""Age at which the keys of a session are forgotten."""
SWEEP_S = 1.0
# Far below what ChaCha20-Poly1305 allows under one key (2**62 datagrams of this size).
SESSION_DATAGRAMS = 2**32


NONE: Mapping[int, None] = MappingProxyType({})
"""No questions: hardly any peer is asked something at any moment, so what has none shares this."""


def _with(numbers: Mapping[int, None], number: int) -> Mapping[int, None]:
    if not isinstance(numbers, dict):
        return {number: None}
    numbers[number] = None
    return numbers


def _without(numbers: Mapping[int, None], number: int) -> Mapping[int, None]:
    if isinstance(numbers, dict):
        numbers.pop(number, None)
    return numbers or NONE


@dataclass(slots=True, eq=False)
class Opening:
    """A handshake of ours that waits for its RESP.

    ``address`` is where it was begun, ``doors`` has every address at which it knocks with the cookie that was asked for
    there, ``within`` in how many seconds it should succeed.  Up to ``held_until`` others help, and it goes on whatever
    the number of its tries.  With ``is_wanted`` somebody here waits for it; else it was begun to let the peer in, or to
    find a better way.  While it ``is_resting`` it only waits for a late RESP.
    """

    invitation: Invitation
    peer: Peer
    address: Address
    started_at: float
    doors: dict[Address, bytes]
    within: float
    tries: int = 0
    knocks: int = 0
    held_until: float = 0.0
    is_wanted: bool = True
    is_resting: bool = False
    timer: IDelayedCall | None = None
    helper: IDelayedCall | None = None


@dataclass(slots=True, eq=False)
class Peer:
    """One peer, known by its public key; ``contact`` says where it was asked last.

    ``own`` is under which of the team's secrets it is to be met, where that is not the newest one.
    """

    contact: Contact
    sessions: tuple[Session, ...] = ()
    opening: Opening | None = None
    round_trip: RoundTrip = field(default_factory=RoundTrip)
    tells: tuple[bytes, ...] = ()
    inquiries: Mapping[int, None] = field(default_factory=lambda: NONE)  # the numbers of what is asked of it, in order
    queue: Mapping[int, None] = field(default_factory=lambda: NONE)  # those of them that have not been sent yet
    in_flight: int = 0
    own: Credentials | None = None

    @property
    def public(self) -> bytes:
        """The key by which it is known."""
        return self.contact.public

    @property
    def session(self) -> Session | None:
        """The session that is used for sending: the newest one."""
        return self.sessions[-1] if self.sessions else None

    @property
    def direct_session(self) -> Session | None:
        """The newest session that no other node carries."""
        return next((session for session in reversed(self.sessions) if not is_relayed(session.contact.address)), None)

    def oldest(self, number: int) -> int:
        """The oldest question that is asked of it; ``number`` where there is none."""
        return next(iter(self.inquiries), number)

    def began(self, number: int) -> None:
        """Take note that a question is asked of it."""
        self.inquiries = _with(self.inquiries, number)

    def ended(self, number: int) -> None:
        """Take note that nobody waits for an answer to a question any more."""
        self.inquiries = _without(self.inquiries, number)

    def put_off(self, number: int) -> None:
        """Take note that a question waits for its turn."""
        self.queue = _with(self.queue, number)

    def taken_up(self, number: int) -> None:
        """Take note that a question waits for its turn no more."""
        self.queue = _without(self.queue, number)

    @property
    def is_idle(self) -> bool:
        """Whether nobody waits for anything from this peer."""
        return self.opening is None and not self.inquiries


class Peers:
    """All peers of an endpoint, ``sessions`` by their index, and the handshakes that we began.

    ``ring`` are the credentials under the team's secrets, newest first; ``door`` says what is shown to others.
    ``on_unheard`` is called with a handshake of ours that got no answer to any of its tries.  ``is_far`` says of which
    addresses others may know more; ``on_silence`` is called with a handshake that such a one does not answer at first,
    ``on_established`` with each session that is used from now on, and ``on_moved`` with one whose peer writes from
    elsewhere.

    ``usual`` is how long anybody takes.  In a network that ``is_wide`` strangers are thought to take as long: there
    are so many that what is asked twice for nothing counts.  ``loss`` is what gets lost of what anybody sends us.
    """

    def __init__(
        self,
        ring: Sequence[Credentials],
        clock: IReactorTime,
        rng: random.Random,
        network: Network,
        counters: Counter[str],
        door: Door = OPEN,
    ) -> None:
        self.ring = ring
        self.door = door
        self.sessions: dict[int, Session] = {}
        self.on_unheard = Listeners[[Opening]]()
        self.is_far: Callable[[Address], bool] = lambda address: False
        self.on_silence = Listeners[[Opening]]()
        self.on_established = Listeners[[Session]]()
        self.on_moved = Listeners[[Session]]()
        self._clock = clock
        self._rng = rng
        self._network = network
        self._counters = counters
        self.usual = RoundTrip()
        self.loss = Loss()
        self.is_wide = False
        self._peers: dict[bytes, Peer] = {}
        self._openings: dict[int, Opening] = {}
        self._stamp = 0
        self._sweeper: IDelayedCall | None = None
        self._by_mac: dict[bytes, Opening] = {}

    def known(self, public: bytes) -> Peer | None:
        """The peer of that key, if anything is remembered of it."""
        return self._peers.get(public)

    def contact(self, public: bytes, address: Address) -> Contact:
        """The contact of that key at that address; where it is known already no second one is made of it."""
        peer = self._peers.get(public)
        if peer is not None and peer.contact.address == address:
            return peer.contact
        return Contact(public, address)

    def session(self, public: bytes) -> Session | None:
        """The newest session with the peer of that key."""
        peer = self._peers.get(public)
        return peer.session if peer is not None else None

    def direct_session(self, public: bytes) -> Session | None:
        """The newest session with the peer of that key that no other node carries."""
        peer = self._peers.get(public)
        return peer.direct_session if peer is not None else None

    def peer(self, contact: Contact) -> Peer:
        """The peer of that contact, remembered from now on; raises ``ValueError`` where its key is none."""
        peer = self._peers.get(contact.public)
        if peer is not None:
            self._peers[contact.public] = self._peers.pop(contact.public)  # whoever is wanted least stands first
            peer.contact = contact
            return peer
        exchange_key(contact.public)  # or it is none
        peer = self._peers[contact.public] = Peer(contact)
        if self.is_wide:
            peer.round_trip = RoundTrip(self.guess)
        if len(self._peers) > MAX_PEERS:
            idle = next((other for other in self._peers.values() if other.is_idle and other is not peer), None)
            if idle is not None:
                del self._peers[idle.public]
                self._end(idle.sessions)
        return peer

    @property
    def guess(self) -> float:
        """How long to wait for the first answer of a stranger, in seconds, as far as others tell."""
        return max(FIRST_GUESS, min(self.usual.wait, MOST_GUESSED))

    def wait_for(self, public: bytes) -> float:
        """How long to wait for a sign of a peer before trying again, in seconds."""
        peer = self._peers.get(public)
        return peer.round_trip.wait if peer is not None and peer.round_trip.is_measured else STRANGER_WAIT

    @property
    def tries(self) -> int:
        """How often anything is tried before it is given up, the usual number at least."""
        return max(MAX_TRIES, self.loss.tries)

    def spacing(self, round_trip: RoundTrip, tries: int, within: float) -> float:
        """Seconds between a try, the ``tries``-th, and the next one of what should succeed ``within`` some seconds.

        Each waits longer than the one before, up to the usual number.  Where much gets lost, they are as close to each
        other as they must be to have as many as it takes; but none comes before most answers would.  Of strangers, who
        may be near or far, nothing is known but how long anybody takes.
        """
        wait = round_trip.wait * BACK_OFF ** (min(tries, MAX_TRIES) - 1)
        likely = round_trip.likely if round_trip.is_measured else self.usual.mean
        return wait if likely is None else min(wait, max(likely, within / self.loss.tries))

    def usable(self, peer: Peer) -> Session | None:
        """The session to send on.

        A worn one is dropped, and one that the other side may have let go of, unless something waits for it.
        """
        session = peer.session
        if session is None:
            return None
        if (peer.is_idle and not self.is_in_touch(peer)) or session.sent > 2 * SESSION_DATAGRAMS:
            self._end(peer.sessions)
            peer.sessions = ()
            return None
        return session

    def renew(self, session: Session) -> None:
        """Open a successor of a session on which something is about to be sent, if it is old or worn.

        Of two peers the one with the lower key does so first, so that there are not two successors.
        """
        public = session.contact.public
        life = SESSION_LIFE_S if self.ring[0].public < public else SESSION_LIFE_S + SECOND_S
        if self._clock.seconds() - session.opened_at < life and session.sent < SESSION_DATAGRAMS:
            return
        peer = self._peers.get(public)
        if peer is not None and session in (peer.session, peer.direct_session):
            self.open(peer, session.contact.address)

    def is_in_touch(self, peer: Peer) -> bool:
        """Whether there is a session of which the other side, if it lives, surely has its end yet.

        In a wide network each lets go of the sessions with a peer that is silent for long, at a moment of its own and
        without a word; what the other one sends on them from then on is lost.
        """
        since = self._clock.seconds() - IN_TOUCH if self.is_wide else float("-inf")
        return any(session.heard_at >= since for session in peer.sessions)

    def established(self, session: Session) -> Peer:
        """Use a session for sending from now on; gives its peer."""
        peer = self.peer(session.contact)
        is_carried = is_relayed(session.contact.address)
        newest = peer.session
        if is_carried and newest is not None and self._is_lively_and_direct(newest):
            peer.sessions = (*peer.sessions[:-1], session, newest)  # one that others carry gives way to one as good
        else:
            peer.sessions = (*peer.sessions, session)
        if len(peer.sessions) > MAX_SESSIONS:
            self._end(peer.sessions[:1])
            peer.sessions = peer.sessions[1:]
        if peer.opening is not None and peer.opening.knocks and not is_carried:
            self.close(peer.opening)  # the peer, which was told to knock too, came first
        if self._sweeper is None:
            self._sweep()
        self.on_established(session)
        return peer

    def _sweep(self) -> None:
        """Forget the sessions that have come to their end, and look again when the next one does."""
        self._sweeper, now = None, self._clock.seconds()
        while self.sessions:  # in the order in which they were opened
            oldest = next(iter(self.sessions.values()))
            left = oldest.opened_at + SESSION_END_S - now
            if left > 0:
                self._sweeper = self._clock.callLater(max(left, SWEEP_S), self._sweep)
                return
            self.drop(oldest)

    def confirmed(self, session: Session) -> None:
        """Learn how far away a peer is that opened a session, and has just confirmed it: one round trip after our RESP.

        Without that, who was asked first would ask back too soon, and take a long way for a peer that restarted.
        """
        peer = self.peer(session.contact)
        if not peer.round_trip.is_measured:
            self.answered(peer, 1, self._clock.seconds() - session.opened_at)

    def answered(self, peer: Peer, tries: int, seconds: float) -> None:
        """Learn from an answer to the last of so many tries, so many seconds after the first."""
        for round_trip in (peer.round_trip, self.usual):
            if tries == 1:
                round_trip.measured(seconds)
            else:
                round_trip.ambiguous(seconds)

    def doubtful(self, peer: Peer) -> int:
        """After how many tries that got no answer a peer may have forgotten our session.

        Where it is not known how far away it is, or much gets lost, one says nothing.
        """
        return 1 if peer.round_trip.is_measured and self.loss.tries == 1 else 2

    def moved(self, session: Session) -> None:
        """Take note that a peer's newest datagram came from another address."""
        peer = self._peers.get(session.contact.public)
        if peer is not None:
            for other in peer.sessions:
                other.contact = session.contact
            self.on_moved(session)

    def rekey(self, ring: Sequence[Credentials]) -> None:
        """Begin handshakes under the first of ``ring`` from now on."""
        self.ring = ring
        for peer in self._peers.values():
            peer.own = None

    def met_under(self, contact: Contact, own: Credentials) -> None:
        """Take note under which of several secrets ``contact`` goes by."""
        if len(self.ring) > 1:
            with suppress(ValueError):  # what it said to be its key is none
                self.peer(contact).own = own

    def evict(self, peer: Peer) -> None:
        """Forget the sessions with a peer, and a handshake with it."""
        if peer.opening is not None:
            self.close(peer.opening)
        self._end(peer.sessions)
        peer.sessions = ()
        peer.tells = ()

    def let_go(self, before: float) -> list[bytes]:
        """Forget the peers that were last heard before that moment, and from whom nobody waits for anything."""
        silent = [
            peer
            for peer in self._peers.values()
            if peer.is_idle and not peer.tells and all(session.heard_at < before for session in peer.sessions)
        ]
        for peer in silent:
            self._end(peer.sessions)
            del self._peers[peer.public]
        return [peer.public for peer in silent]

    def drop(self, session: Session) -> None:
        """Forget one session."""
        self._end([session])
        peer = self._peers.get(session.contact.public)
        if peer is not None:
            peer.sessions = tuple(other for other in peer.sessions if other is not session)

    @property
    def hello(self) -> Hello:
        """What this node says of itself in a handshake."""
        door = self.door
        return Hello(door.life, door.shown, door.room)

    def new_index(self) -> int:
        """A free index for a session; 0 is none."""
        while True:
            index = self._rng.getrandbits(8 * INDEX_BYTES)
            if index and index not in self.sessions and index not in self._openings:
                return index

    def stop(self) -> None:
        """Cancel every handshake and forget every peer."""
        for opening in self._openings.values():
            cancel(opening.timer)
            cancel(opening.helper)
        cancel(self._sweeper)
        self._sweeper = None
        self._openings.clear()
        self._by_mac.clear()
        self._peers.clear()
        self.sessions.clear()

    # -- handshakes of ours -----------------------------------------------------------------------------------------

    def open(
        self, peer: Peer, address: Address, rider: bytes = b"", is_wanted: bool = True, within: float = OPENING_S
    ) -> bool:
        """Open a session, unless that is under way; False where there are too many handshakes.

        ``rider`` is a message for its INIT; one that does not fit stays behind.  ``within`` is in how many seconds
        whoever wants it needs it.
        """
        if peer.opening is not None:
            if is_wanted and not peer.opening.is_wanted:
                peer.opening.is_wanted = True
                peer.opening.doors.setdefault(address, b"")
                self._prepare_help(peer.opening, address)
            if peer.opening.is_resting and not peer.sessions:
                cancel(peer.opening.timer)
                self._knock(peer.opening, is_asked=True)
            return True
        if len(self._openings) >= MAX_OPENINGS:
            self._counters["crowded"] += 1
            return False
        own, hello = peer.own or self.ring[0], self.hello
        rider = rider if len(rider) <= hello.rider_room else b""
        now = self._clock.seconds()
        self._stamp = max(self._stamp + 1, int(now * 1e6))
        secret, index = self._rng.randbytes(32), self.new_index()
        invitation = Invitation(own, exchange_key(peer.public), secret, index, rider, hello, self._stamp)
        opening = Opening(invitation, peer, address, now, {address: b""}, within)
        self._openings[invitation.local_index] = self._by_mac[invitation.mac] = peer.opening = opening
        opening.is_wanted = is_wanted
        if is_wanted:
            self._prepare_help(opening, address)
        self._knock(opening)
        return True

    def hold(self, opening: Opening, until: float) -> None:
        """Go on with a handshake up to a moment, since others help; an earlier one than now: no longer than usual."""
        if opening.peer.opening is opening:
            opening.held_until = until

    def knock_at(self, opening: Opening, addresses: Iterable[Address]) -> None:
        """Knock at further addresses, at once and often from now on."""
        if opening.peer.opening is not opening:
            return
        for address in addresses:
            if len(opening.doors) < MAX_DOORS:
                opening.doors.setdefault(address, b"")
        opening.knocks = 1
        cancel(opening.timer)
        self._knock(opening)

    def opening(self, index: int) -> Opening | None:
        """The handshake of ours that has this session index."""
        return self._openings.get(index)

    def opening_of(self, mac: bytes) -> Opening | None:
        """The handshake of ours whose INIT has this hash."""
        return self._by_mac.get(mac)

    def paid(self, opening: Opening, cookie: bytes, source: Address) -> None:
        """Send the INIT again at once, with the cookie that the responder asked for at that address."""
        if opening.doors.get(source) != cookie:
            opening.doors[source] = cookie
            self._network.send(opening.invitation.datagram(cookie), source)

    def accepted(self, opening: Opening) -> None:
        """Take note that a handshake of ours got its RESP."""
        self.close(opening)
        if not opening.knocks:  # else the way had to be opened first, which says nothing of its length
            tries = opening.tries + any(opening.doors.values())  # who asked for a cookie was asked twice
            self.answered(opening.peer, tries, self._clock.seconds() - opening.started_at)

    def _knock(self, opening: Opening, is_asked: bool = False) -> None:
        """Send an INIT, again if need be, until the tries are used up, or as long as somebody waits.

        ``is_asked``: somebody does, from now on.
        """
        left = opening.started_at + OPENING_S - self._clock.seconds()
        opening.is_resting = not is_asked and opening.tries > 0 and self._is_enough(opening)
        is_over = left <= 0 if opening.is_resting else opening.tries >= self.tries
        if is_over and self._clock.seconds() >= opening.held_until:
            self.close(opening)
            if len(self.ring) > 1:  # it may not have heard of the newest secret, or of nothing older any more
                ring = list(self.ring)
                tried = ring.index(opening.invitation.own) if opening.invitation.own in ring else -1
                opening.peer.own = ring[(tried + 1) % len(ring)]
            self.on_unheard(opening)
            return
        if opening.is_resting:
            opening.timer = self._clock.callLater(left, self._knock, opening)
            return
        opening.tries += 1
        for address, cookie in opening.doors.items():
            self._network.send(opening.invitation.datagram(cookie), address)
        if opening.knocks:
            opening.knocks += 1
            wait = min(KNOCK_S * BACK_OFF ** max(0, opening.knocks - KNOCKS), LONGEST)
        else:
            wait = self._wait(opening)
        opening.timer = self._clock.callLater(wait, self._knock, opening)

    def _is_enough(self, opening: Opening) -> bool:
        """Whether its INIT, the dearest of all datagrams, was sent as often as is worth while.

        If it was begun for questions, until nobody waits for their answers any more.  Beside a session that stands it
        only asks whether the peer forgot that one, or succeeds it: what is asked goes out on the session as well, and
        the next question would ask anew.
        """
        peer = opening.peer
        if not opening.is_wanted or opening.knocks or opening.held_until:
            return False
        if peer.sessions:
            return opening.tries >= max(DOUBTS, self.loss.tries)
        return not (peer.inquiries or peer.tells)

    def _wait(self, opening: Opening) -> float:
        round_trip = opening.peer.round_trip
        wait = self.spacing(round_trip, opening.tries, opening.within)
        if opening.tries == self.tries and not round_trip.is_measured:
            # Nothing is known of this peer: it may be far away rather than gone.
            wait = max(wait, opening.started_at + OPENING_S - self._clock.seconds())
        return wait

    def _prepare_help(self, opening: Opening, address: Address) -> None:
        if self.is_far(address):
            wait = 0.0 if is_relayed(address) else HELP_S
            opening.helper = self._clock.callLater(wait, self.on_silence, opening)

    def _is_lively_and_direct(self, session: Session) -> bool:
        is_lively = self._clock.seconds() - session.heard_at < LIVELY_S
        return is_lively and not is_relayed(session.contact.address)

    def close(self, opening: Opening) -> None:
        """Forget a handshake of ours."""
        cancel(opening.timer)
        cancel(opening.helper)
        self._openings.pop(opening.invitation.local_index, None)
        self._by_mac.pop(opening.invitation.mac, None)
        opening.peer.opening = None

    def _end(self, sessions: Iterable[Session]) -> None:
        for session in sessions:
            self.sessions.pop(session.local_index, None)
