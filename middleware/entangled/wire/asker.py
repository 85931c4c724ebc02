"""Asker: our questions until they are answered, and the handshakes that they need.

It decides when to try again and when to give up, and remembers the peers.  It reads no datagrams: the endpoint tells it
what arrived.
"""

from __future__ import annotations

import random
from collections import Counter, OrderedDict
from collections.abc import Callable

from twisted.internet import defer
from twisted.internet.defer import Deferred
from twisted.internet.interfaces import IDelayedCall, IReactorTime

from middleware.entangled.errors import NoAnswer, Refused, TooLarge
from middleware.entangled.identity import exchange_key
from middleware.entangled.kademlia.contact import Contact
from middleware.entangled.network.network import Address, Network
from middleware.entangled.wire.handshake import MAX_RIDER, Credentials, Invitation
from middleware.entangled.wire.message import Answer, Failure, Question, Told, encoded
from middleware.entangled.wire.peer import (
    MAX_SESSIONS,
    SESSION_END_S,
    SESSION_LIFE_S,
    Inquiry,
    Opening,
    Peer,
)
from middleware.entangled.wire.roundtrip import BACK_OFF
from middleware.entangled.wire.session import MAX_MESSAGE, Session

MAX_TRIES = 4
MAX_PEERS = 4096
MAX_OPENINGS = 1024
MAX_TELLS = 32
OPENING_S = 1.5
SILENCE_S = 5.0


class Asker:
    """What an endpoint wants from others.

    ``ended`` is called with sessions that are no longer used, ``new_index`` gives a free session index.
    """

    def __init__(
        self,
        own: Credentials,
        clock: IReactorTime,
        rng: random.Random,
        network: Network,
        ended: Callable[[list[Session]], None],
        new_index: Callable[[], int],
        counters: Counter[str],
    ) -> None:
        self._own = own
        self._clock = clock
        self._rng = rng
        self._network = network
        self._ended = ended
        self._new_index = new_index
        self._counters = counters
        self._peers: OrderedDict[bytes, Peer] = OrderedDict()
        self._inquiries: dict[int, Inquiry] = {}
        self._openings: dict[int, Opening] = {}
        # Starting anywhere in 62 bits keeps the numbers of a restarted node apart from those it used before.
        self._next_number = rng.getrandbits(62)

    def ask(
        self,
        contact: Contact,
        method: str,
        arguments: tuple[object, ...],
        patience: float,
        is_patient: bool,
        changes: bool,
    ) -> Deferred[object]:
        """Ask, for ``patience`` seconds; see ``Endpoint.ask``."""
        number = self._next_number
        try:
            message = encoded(Question(number, method, arguments))
        except (TypeError, ValueError, OverflowError) as error:
            return defer.fail(error)
        if len(message) > MAX_MESSAGE:
            return defer.fail(TooLarge(_too_large(method, message)))
        try:
            peer = self._peer(contact)
        except ValueError:
            return defer.fail(NoAnswer(f"{contact.address}: the key of this contact is no key"))
        self._next_number += 1
        now = self._clock.seconds()
        deferred: Deferred[object] = Deferred(lambda _: self._forget(inquiry))
        inquiry = Inquiry(
            number, method, peer, contact.address, message, changes, now, now + patience, is_patient, deferred
        )
        self._inquiries[number] = peer.inquiries[number] = inquiry
        if self._usable(peer) is not None:
            self._try(inquiry)
        else:
            self._set_timer(inquiry, patience)
            if not self._open(peer, inquiry.address, inquiry):
                self._fail(inquiry, "too many handshakes are under way")
        return deferred

    def tell(self, contact: Contact, method: str, arguments: tuple[object, ...]) -> None:
        """Tell; see ``Endpoint.tell``."""
        message = encoded(Told(method, arguments))
        if len(message) > MAX_MESSAGE:
            raise TooLarge(_too_large(method, message))
        try:
            peer = self._peer(contact)
        except ValueError:
            self._counters["untold"] += 1
            return
        session = self._usable(peer)
        if session is not None:
            self._network.send(session.seal(message), session.contact.address)
            if self._clock.seconds() - session.heard_at > SILENCE_S:
                self._open(
                    peer, contact.address
                )  # nobody answers a tell: without this a restarted peer would never be noticed
        elif len(peer.tells) < MAX_TELLS and (peer.opening is not None or self._open(peer, contact.address)):
            peer.tells.append(message)
        else:
            self._counters["untold"] += 1

    def stop(self, error: Exception) -> None:
        """Cancel every timer, fail every question with ``error``, forget every peer."""
        for opening in self._openings.values():
            _cancel(opening.timer)
        self._openings.clear()
        inquiries = list(self._inquiries.values())
        for inquiry in inquiries:
            self._forget(inquiry)
        self._peers.clear()
        for inquiry in inquiries:
            inquiry.deferred.errback(error)

    def opening(self, index: int) -> Opening | None:
        """The handshake of ours that has this session index."""
        return self._openings.get(index)

    def is_asked(self, number: int, public: bytes) -> bool:
        """Whether the question ``number`` waits for an answer of the peer with that key."""
        inquiry = self._inquiries.get(number)
        return inquiry is not None and inquiry.peer.public == public

    def resolve(self, message: Answer | Failure, public: bytes) -> None:
        """Hand an answer to the one who asked; an answer that nobody waits for is counted."""
        inquiry = self._inquiries.get(message.id)
        if inquiry is None or inquiry.peer.public != public:
            self._counters["unasked"] += 1
            return
        if inquiry.tries == 1:
            inquiry.peer.round_trip.measured(self._clock.seconds() - inquiry.sent_at)
        elif inquiry.tries > 1:
            inquiry.peer.round_trip.ambiguous()
        self._forget(inquiry)
        if isinstance(message, Answer):
            inquiry.deferred.callback(message.value)
        else:
            inquiry.deferred.errback(Refused(message.text))

    def accepted(self, opening: Opening) -> None:
        """Take note that a handshake of ours got its RESP."""
        self._close(opening)
        if opening.tries == 1:
            opening.peer.round_trip.measured(self._clock.seconds() - opening.started_at)

    def established(self, session: Session, is_owed: bool = False) -> None:
        """Use a session from now on, and send what waited for it; ``is_owed`` where the peer waits to hear from us."""
        peer = self._peer(session.contact)
        peer.sessions.append(session)
        if len(peer.sessions) > MAX_SESSIONS:
            self._ended([peer.sessions.pop(0)])
        sent = 0
        for message in peer.tells:
            self._network.send(session.seal(message), session.contact.address)
            sent += 1
        peer.tells.clear()
        for inquiry in list(peer.inquiries.values()):
            if inquiry.tries == 0 or is_owed:  # of those that were tried, the peer may have lost the session
                self._try(inquiry)
                sent += 1
        if is_owed and not sent:
            self._network.send(session.seal(b""), session.contact.address)

    def moved(self, session: Session) -> None:
        """Take note that a peer's newest datagram came from another address."""
        peer = self._peers.get(session.contact.public)
        if peer is None:
            return
        for other in peer.sessions:
            other.contact = session.contact

    def _peer(self, contact: Contact) -> Peer:
        """The peer of that key; raises ``ValueError`` where the key is none."""
        peer = self._peers.get(contact.public)
        if peer is not None:
            self._peers.move_to_end(contact.public)
            return peer
        peer = self._peers[contact.public] = Peer(contact.public, exchange_key(contact.public))
        if len(self._peers) > MAX_PEERS:
            idle = next((other for other in self._peers.values() if other.is_idle and other is not peer), None)
            if idle is not None:
                del self._peers[idle.public]
                self._ended(idle.sessions)
        return peer

    def _usable(self, peer: Peer) -> Session | None:
        """The session to send on; an old one calls for its successor, a very old one is dropped."""
        session = peer.session
        if session is None:
            return None
        age = self._clock.seconds() - session.opened_at
        if age > SESSION_END_S:
            self._ended(peer.sessions)
            peer.sessions = []
            return None
        if age > SESSION_LIFE_S:
            self._open(peer, session.contact.address)
        return session

    def _try(self, inquiry: Inquiry) -> None:
        """Send a question on the peer's newest session, and set its timer."""
        session = inquiry.peer.sessions[-1]
        now = self._clock.seconds()
        inquiry.tries += 1
        if inquiry.tries == 1:
            inquiry.sent_at = now
        self._network.send(session.seal(inquiry.message), session.contact.address)
        wait = inquiry.peer.round_trip.wait * BACK_OFF ** min(inquiry.tries - 1, MAX_TRIES)
        if inquiry.is_patient and inquiry.tries > 1:
            # A method that takes its time: the later tries are there for an answer that got lost.
            wait = max(wait, (inquiry.deadline - now) / max(1, MAX_TRIES + 1 - inquiry.tries))
        self._set_timer(inquiry, wait)

    def _due(self, inquiry: Inquiry) -> None:
        """Decide what to do about a question that has waited long enough."""
        now, peer = self._clock.seconds(), inquiry.peer
        left = inquiry.deadline - now
        if left <= 0:
            self._fail(inquiry, f"no answer in {now - inquiry.asked_at:.2f} s")
            return
        session = self._usable(peer)
        if session is None:
            if not self._open(peer, inquiry.address, inquiry):
                self._fail(inquiry, "too many handshakes are under way")
            else:
                self._set_timer(inquiry, left)
        elif inquiry.tries >= MAX_TRIES:
            is_alive = session.heard_at > inquiry.sent_at
            if inquiry.is_patient or is_alive or peer.opening is not None or not peer.round_trip.is_measured:
                self._set_timer(inquiry, left)
            else:
                self._fail(inquiry, f"no answer to {inquiry.tries} tries")
        else:
            if session.heard_at <= inquiry.sent_at:
                self._open(peer, inquiry.address, inquiry)  # perhaps it restarted and knows no session
            self._try(inquiry)

    def _open(self, peer: Peer, address: Address, inquiry: Inquiry | None = None) -> bool:
        """Open a session, unless that is under way; False where there are too many handshakes."""
        if peer.opening is not None:
            return True
        if len(self._openings) >= MAX_OPENINGS:
            self._counters["crowded"] += 1
            return False
        rides = inquiry is not None and not inquiry.changes and len(inquiry.message) <= MAX_RIDER
        rider = inquiry if rides else None
        invitation = Invitation(
            self._own,
            peer.static,
            self._rng.randbytes(32),
            self._new_index(),
            rider.message if rider is not None else b"",
        )
        opening = Opening(invitation, peer, address, rider, self._clock.seconds())
        self._openings[invitation.local_index] = peer.opening = opening
        self._knock(opening)
        return True

    def _knock(self, opening: Opening) -> None:
        """Send an INIT, again if need be, until the tries are used up."""
        if opening.tries >= MAX_TRIES:
            self._give_up(opening)
            return
        opening.tries += 1
        self._network.send(opening.invitation.datagram, opening.address)
        round_trip = opening.peer.round_trip
        wait = round_trip.wait * BACK_OFF ** (opening.tries - 1)
        if opening.tries == MAX_TRIES and not round_trip.is_measured:
            # Nothing is known of this peer: it may be far away rather than gone.
            wait = max(wait, opening.started_at + OPENING_S - self._clock.seconds())
        opening.timer = self._clock.callLater(wait, self._knock, opening)

    def _give_up(self, opening: Opening) -> None:
        peer = opening.peer
        self._close(opening)
        self._counters["untold"] += len(peer.tells)
        peer.tells.clear()
        if peer.sessions:
            for inquiry in list(peer.inquiries.values()):
                if inquiry.tries >= MAX_TRIES:  # it waited for this handshake only
                    self._due(inquiry)
            return  # the others have their own timers
        for inquiry in list(peer.inquiries.values()):
            had_its_chance = inquiry.asked_at <= opening.started_at and inquiry.address == opening.address
            if inquiry.is_patient or not had_its_chance:
                if not self._open(peer, inquiry.address, inquiry):
                    self._fail(inquiry, "too many handshakes are under way")
            else:
                self._fail(inquiry, f"no answer to {opening.tries} handshakes")

    def _close(self, opening: Opening) -> None:
        _cancel(opening.timer)
        self._openings.pop(opening.invitation.local_index, None)
        opening.peer.opening = None

    def _set_timer(self, inquiry: Inquiry, wait: float) -> None:
        _cancel(inquiry.timer)
        wait = max(0.0, min(wait, inquiry.deadline - self._clock.seconds()))
        inquiry.timer = self._clock.callLater(wait, self._due, inquiry)

    def _fail(self, inquiry: Inquiry, why: str) -> None:
        self._forget(inquiry)
        inquiry.deferred.errback(NoAnswer(f"{inquiry.method} asked of {inquiry.address}: {why}"))

    def _forget(self, inquiry: Inquiry) -> None:
        _cancel(inquiry.timer)
        self._inquiries.pop(inquiry.number, None)
        inquiry.peer.inquiries.pop(inquiry.number, None)


def _cancel(timer: IDelayedCall | None) -> None:
    if timer is not None and timer.active():
        timer.cancel()


def _too_large(method: str, message: bytes) -> str:
    return f"{method}: the message has {len(message)} bytes, {MAX_MESSAGE} can be sent; split or shorten it"
