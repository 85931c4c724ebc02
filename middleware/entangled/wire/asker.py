"""Keep the requests of this node until they are answered, and send notifications.

It decides when to retransmit a request and when to give it up.  The endpoint calls it with each received answer.
"""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

from twisted.internet import defer
from twisted.internet.defer import Deferred
from twisted.internet.interfaces import IDelayedCall, IReactorTime

from middleware.entangled.background import cancel
from middleware.entangled.contact import Contact
from middleware.entangled.errors import Crowded, NoAnswer, TooLarge
from middleware.entangled.network.network import Address
from middleware.entangled.wire.congestion import LONGEST
from middleware.entangled.wire.courier import Courier
from middleware.entangled.wire.message import (
    MAX_MESSAGE,
    Answer,
    Cancel,
    Failure,
    Key,
    Question,
    Told,
    aged,
    encoded,
)
from middleware.entangled.wire.method import error_of
from middleware.entangled.wire.peer import OPENING_S, Opening, Peer, Peers
from middleware.entangled.wire.session import MAX_PLAIN, Session

PATIENCE = 1.5
MAX_TELLS = 32
SILENCE_S = 5.0
MAX_IN_FLIGHT = 32
"""Requests that may be under way to one peer; further ones wait in a queue. They take a quarter of the usual receive
buffer of 208 KiB, because other nodes send requests to the same peer."""
MAX_QUEUED = 8192
LONGEST_QUEUED = 10.0
_QUEUED = "timed out in the queue; send fewer requests at the same time"
_CROWDED = "too many handshakes are under way; try again later"
_FULL = "too many requests or bytes are under way; try again later"


@dataclass(slots=True, eq=False)
class Inquiry:
    """A request that waits for its answer.

    ``is_patient``: the caller gave a longer timeout than the default; ``is_bulky``: the request is sent in fragments;
    ``is_light``: the request does not justify a handshake. ``grace`` is the time in seconds that the answer has after
    the request left the queue and after each acknowledged fragment; 0 if the caller gave a timeout.
    """

    number: int
    method: str
    peer: Peer
    address: Address
    message: bytes
    changes: bool
    asked_at: float
    deadline: float
    is_patient: bool
    is_bulky: bool
    is_light: bool
    grace: float
    deferred: Deferred[object]
    tries: int = 0
    sent_at: float = 0.0
    progress_at: float = -1.0
    timer: IDelayedCall | None = None

    @property
    def is_counted(self) -> bool:
        """Whether the request counts towards ``MAX_IN_FLIGHT``; fragments have their own congestion window."""
        return not (self.is_patient or self.is_bulky)


class Asker:
    """The outgoing requests of an endpoint; ``send`` is called with a session and the bytes of a message."""

    def __init__(
        self,
        clock: IReactorTime,
        rng: random.Random,
        peers: Peers,
        courier: Courier,
        send: Callable[[Session, bytes], None],
        counters: Counter[str],
    ) -> None:
        self._clock = clock
        self._peers = peers
        self._send = send
        self._counters = counters
        self._courier = courier
        self._inquiries: dict[int, Inquiry] = {}
        self._queued = 0
        # A random start within 62 bits keeps the request ids of a restarted node apart from its earlier ones.
        self._next_number = rng.getrandbits(62)
        peers.on_unheard.add(self._fail_unanswered)

    def ask(
        self,
        contact: Contact,
        method: str,
        arguments: tuple[object, ...],
        timeout: float | None,
        changes: bool,
        is_light: bool = False,
    ) -> Deferred[object]:
        """Send a request; see ``Endpoint.ask``."""
        number = self._next_number
        try:
            peer = self._peers.peer(contact)
        except ValueError:
            return defer.fail(NoAnswer(f"{contact.address}: the public key of this contact is invalid"))
        try:
            message = encoded(Question(number, method, arguments, behind=number - peer.oldest(number)))
        except (TypeError, ValueError, OverflowError) as error:
            return defer.fail(error)
        if len(message) > MAX_MESSAGE:
            return defer.fail(TooLarge(_too_large(method, message, MAX_MESSAGE)))
        if self._queued >= MAX_QUEUED:
            self._counters["crowded"] += 1
            return defer.fail(Crowded(f"{method} asked of {contact.address}: {_FULL}"))
        is_bulky = len(message) > MAX_PLAIN
        if is_bulky and not self._courier.reserve(contact.public, len(message)):
            return defer.fail(Crowded(f"{method} asked of {contact.address}: {_FULL}"))
        self._next_number += 1
        now = self._clock.seconds()
        patience = PATIENCE if timeout is None else timeout
        deferred: Deferred[object] = Deferred(lambda _: self._cancel(inquiry))
        inquiry = Inquiry(
            number=number,
            method=method,
            peer=peer,
            address=contact.address,
            message=message,
            changes=changes,
            asked_at=now,
            deadline=now + patience,
            is_patient=patience > PATIENCE,
            is_bulky=is_bulky,
            is_light=is_light,
            grace=PATIENCE if timeout is None else 0.0,
            deferred=deferred,
        )
        is_open = self._peers.usable(peer) is not None  # before the request itself marks the session as in use
        self._inquiries[number] = inquiry
        peer.began(number)
        if is_open and (peer.in_flight < MAX_IN_FLIGHT or not inquiry.is_counted):
            self._try(inquiry)
            return deferred
        peer.put_off(number)
        self._queued += 1
        self._set_timer(inquiry, patience)
        if not is_open and not self._open(inquiry):
            self._fail(inquiry, _CROWDED)
        return deferred

    def tell(self, contact: Contact, method: str, arguments: tuple[object, ...]) -> None:
        """Send a notification; see ``Endpoint.tell``."""
        message = encoded(Told(method, arguments))
        if len(message) > MAX_PLAIN:
            raise TooLarge(_too_large(method, message, MAX_PLAIN))
        try:
            peer = self._peers.peer(contact)
        except ValueError:
            self._counters["untold"] += 1
            return
        session = self._peers.usable(peer)
        if session is not None:
            self._send(session, message)
            if self._clock.seconds() - session.heard_at > SILENCE_S:
                # A notification has no answer: without this handshake a restart of the peer would go unnoticed.
                self._peers.open(peer, contact.address)
        elif len(peer.tells) < MAX_TELLS and (peer.opening is not None or self._peers.open(peer, contact.address)):
            peer.tells += (message,)
        else:
            self._counters["untold"] += 1

    def stop(self, error: Exception) -> None:
        """Cancel every timer and fail every request with ``error``."""
        self._fail_all(list(self._inquiries.values()), lambda: error)

    def refused(self, peer: Peer, error: Callable[[], Exception]) -> None:
        """Fail every request to a peer, because one of the two nodes rejects the other."""
        self._counters["untold"] += len(peer.tells)
        peer.tells = ()
        self._fail_all(self._inquiries_of(peer), error)

    def is_asked(self, number: int, public: bytes) -> bool:
        """Return whether the request ``number`` waits for an answer from the peer with that key."""
        inquiry = self._inquiries.get(number)
        return inquiry is not None and inquiry.peer.public == public

    def progressed(self, number: int, public: bytes) -> None:
        """Record that the peer acknowledged a fragment of a request, or that a fragment of its answer arrived."""
        if self.is_asked(number, public):
            inquiry = self._inquiries[number]
            inquiry.progress_at = self._clock.seconds()
            inquiry.deadline = max(inquiry.deadline, inquiry.progress_at + inquiry.grace)

    def resolve(self, message: Answer | Failure, public: bytes) -> None:
        """Pass an answer to its caller, or count an answer that no request waits for."""
        inquiry = self._inquiries.get(message.id)
        if inquiry is None or inquiry.peer.public != public:
            self._counters["unasked"] += 1
            return
        is_timed = inquiry.tries > 0 and inquiry.progress_at < 0 and not inquiry.is_bulky
        if is_timed:  # otherwise the time includes the handshake or the transfer
            self._peers.answered(inquiry.peer, inquiry.tries, self._clock.seconds() - inquiry.sent_at)
        self._forget(inquiry)
        if isinstance(message, Answer):
            inquiry.deferred.callback(message.value)
        else:
            inquiry.deferred.errback(error_of(message))

    def established(self, peer: Peer, session: Session, is_owed: bool) -> None:
        """Send the messages that waited for a session; ``is_owed``: the peer waits for a datagram in it."""
        sent = 0
        for message in peer.tells:
            self._send(session, message)
            sent += 1
        peer.tells = ()
        if is_owed:  # the peer may have lost the session in which these requests were sent
            for inquiry in self._inquiries_of(peer):
                if inquiry.tries:
                    self._try(inquiry)
                    sent += 1
        sent += self._try_queued(peer)
        if is_owed and not sent:
            self._send(session, b"")

    def _try(self, inquiry: Inquiry) -> None:
        """Send a request in the peer's newest session and set its timer."""
        session = inquiry.peer.sessions[-1]
        now = self._clock.seconds()
        inquiry.tries += 1
        if inquiry.tries == 1:
            inquiry.sent_at = now
            inquiry.peer.in_flight += inquiry.is_counted
        message = aged(inquiry.message, inquiry.deadline - now)
        if inquiry.is_bulky:
            self._courier.post(inquiry.peer.public, Key(False, inquiry.number), message)
        else:
            self._send(session, message)
        within = inquiry.deadline - inquiry.asked_at
        wait = self._peers.spacing(inquiry.peer.round_trip, inquiry.tries, within)
        if inquiry.is_patient and inquiry.tries > 1:
            # A slow method: the later retransmissions are for an answer that was lost.
            wait = max(wait, (inquiry.deadline - now) / max(1, self._peers.tries + 1 - inquiry.tries))
        self._set_timer(inquiry, wait)

    def _on_timer(self, inquiry: Inquiry) -> None:
        """Retransmit a request, open a session for it, or fail it, when its timer fires."""
        now, peer = self._clock.seconds(), inquiry.peer
        left = inquiry.deadline - now
        if left <= 0 and inquiry.number in peer.queue and peer.session is not None:
            # The request is queued behind others that the peer is answering; its delay does not mean that the peer
            # failed.
            left = min(peer.session.heard_at, inquiry.asked_at + LONGEST_QUEUED) + inquiry.grace - now
            if left <= 0:
                self._fail(inquiry, _QUEUED)
            else:
                inquiry.deadline = now + left
                self._set_timer(inquiry, left)
            return
        if left <= 0:
            self._fail(inquiry, f"no answer in {now - inquiry.asked_at:.2f} s")
            return
        session = self._peers.usable(peer)
        is_silent = session is not None and session.heard_at <= inquiry.sent_at
        if session is None:
            if not self._open(inquiry):
                self._fail(inquiry, _CROWDED)
            else:
                self._set_timer(inquiry, left)
        elif inquiry.is_bulky or inquiry.progress_at >= 0:
            # The courier retransmits fragments; a handshake is needed only if the peer lost the session.
            if is_silent or now - session.heard_at > LONGEST:
                self._open(inquiry)
            self._set_timer(inquiry, LONGEST)
        elif inquiry.tries >= self._peers.tries:
            is_opening = peer.opening is not None and not peer.opening.is_resting
            if inquiry.is_patient or not is_silent or is_opening or not peer.round_trip.is_measured:
                self._set_timer(inquiry, left)
            else:
                self._fail(inquiry, f"no answer to {inquiry.tries} tries")
        else:
            if is_silent and not inquiry.is_light and inquiry.tries >= self._peers.doubtful(peer):
                self._open(inquiry)  # the peer may have restarted without the session
            self._try(inquiry)

    def _try_queued(self, peer: Peer) -> int:
        """Send queued requests to a peer up to ``MAX_IN_FLIGHT``; return their number."""
        sent = 0
        while peer.queue and peer.in_flight < MAX_IN_FLIGHT and self._peers.usable(peer) is not None:
            inquiry = self._inquiries[next(iter(peer.queue))]
            self._leave_queue(inquiry)
            # Without a timeout from the caller, the time for the answer starts now.
            inquiry.deadline = max(inquiry.deadline, self._clock.seconds() + inquiry.grace)
            self._try(inquiry)
            sent += 1
        return sent

    def _leave_queue(self, inquiry: Inquiry) -> None:
        if inquiry.number in inquiry.peer.queue:
            inquiry.peer.taken_up(inquiry.number)
            self._queued -= 1

    def _inquiries_of(self, peer: Peer) -> list[Inquiry]:
        return [self._inquiries[number] for number in peer.inquiries]

    def _open(self, inquiry: Inquiry) -> bool:
        """Open a session for a request, which the INIT carries if allowed; return False for too many handshakes."""
        left = inquiry.deadline - self._clock.seconds()
        rider = b"" if inquiry.changes else aged(inquiry.message, left)
        return self._peers.open(inquiry.peer, inquiry.address, rider, within=min(left, OPENING_S))

    def _fail_unanswered(self, opening: Opening) -> None:
        """Fail the requests that waited for a handshake that got no answer."""
        peer = opening.peer
        self._counters["untold"] += len(peer.tells)
        peer.tells = ()
        if peer.sessions:
            for inquiry in self._inquiries_of(peer):
                if inquiry.tries >= self._peers.tries:  # it waited for this handshake only
                    self._on_timer(inquiry)
            return  # the others have their own timers
        for inquiry in self._inquiries_of(peer):
            was_tried = inquiry.asked_at <= opening.started_at and inquiry.address == opening.address
            if inquiry.is_patient or not was_tried:
                if not self._open(inquiry):
                    self._fail(inquiry, _CROWDED)
            else:
                self._fail(inquiry, f"no answer to {opening.tries} handshakes")

    def _set_timer(self, inquiry: Inquiry, wait: float) -> None:
        cancel(inquiry.timer)
        wait = max(0.0, min(wait, inquiry.deadline - self._clock.seconds()))
        inquiry.timer = self._clock.callLater(wait, self._on_timer, inquiry)

    def _fail_all(self, inquiries: list[Inquiry], error: Callable[[], Exception]) -> None:
        for inquiry in inquiries:
            self._drop(inquiry)
        for inquiry in inquiries:
            inquiry.deferred.errback(error())

    def _fail(self, inquiry: Inquiry, why: str) -> None:
        self._forget(inquiry)
        kind = Crowded if why in (_CROWDED, _QUEUED) else NoAnswer
        inquiry.deferred.errback(kind(f"{inquiry.method} asked of {inquiry.address}: {why}"))

    def _cancel(self, inquiry: Inquiry) -> None:
        """Forget a request that its caller cancelled, and notify the peer."""
        self._forget(inquiry)
        session = self._peers.usable(inquiry.peer)
        if session is not None and inquiry.tries:
            self._send(session, encoded(Cancel(inquiry.number)))

    def _forget(self, inquiry: Inquiry) -> None:
        """Remove a request and send the next queued one."""
        self._drop(inquiry)
        self._try_queued(inquiry.peer)

    def _drop(self, inquiry: Inquiry) -> None:
        cancel(inquiry.timer)
        if self._inquiries.pop(inquiry.number, None) is None:
            return
        inquiry.peer.ended(inquiry.number)
        self._leave_queue(inquiry)
        if inquiry.tries:
            inquiry.peer.in_flight -= inquiry.is_counted
        if inquiry.is_bulky:
            self._courier.drop(inquiry.peer.public, Key(False, inquiry.number))
            self._courier.release(inquiry.peer.public, len(inquiry.message))
        if inquiry.progress_at >= 0:
            self._courier.forget(inquiry.peer.public, Key(True, inquiry.number))


def _too_large(method: str, message: bytes, most: int) -> str:
    return f"{method}: the message has {len(message)} bytes, the limit is {most}; split or shorten it"
