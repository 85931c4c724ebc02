"""Send the requests of this node, wait for their answers, and send notifications.

The requester decides when to retransmit a request and when to fail it.  The endpoint passes each received answer to the
requester.
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
from middleware.entangled.wire.congestion import MAX_TIMEOUT_S
from middleware.entangled.wire.fragmenter import Fragmenter
from middleware.entangled.wire.message import (
    MAX_MESSAGE_BYTES,
    Answer,
    Cancel,
    Failure,
    MessageKey,
    Notification,
    Request,
    encode,
    set_remaining_time,
)
from middleware.entangled.wire.method import make_error
from middleware.entangled.wire.peer import HANDSHAKE_S, OutgoingHandshake, Peer, Peers
from middleware.entangled.wire.session import MAX_PLAIN_BYTES, Session

TIMEOUT_S = 1.5
MAX_NOTIFICATIONS = 32
SILENCE_S = 5.0
MAX_IN_FLIGHT = 32
"""The number of requests that may be under way to one peer; further requests wait in a queue.  These requests take a
quarter of the usual receive buffer of 208 KiB, because other nodes also send requests to the same peer."""
MAX_QUEUED = 8192
MAX_QUEUED_S = 10.0
_QUEUE_TIMEOUT_TEXT = "the request timed out in the queue; send fewer requests at the same time"
_HANDSHAKES_TEXT = "too many handshakes are under way; try again later"
_FULL_TEXT = "too many requests or bytes are under way; try again later"


@dataclass(slots=True, eq=False)
class PendingRequest:
    """A request that waits for its answer.

    ``has_long_timeout``: the caller gave a longer timeout than the default.  ``is_fragmented``: the request is sent in
    fragments.  ``avoids_handshake``: no handshake may be started for the request alone.  ``extension_s`` is the time in
    seconds within which the answer must arrive after the request left the queue and after each acknowledged fragment; 0
    if the caller gave a timeout.
    """

    number: int
    method: str
    peer: Peer
    address: Address
    message: bytes
    changes: bool
    created_at: float
    deadline: float
    has_long_timeout: bool
    is_fragmented: bool
    avoids_handshake: bool
    extension_s: float
    deferred: Deferred[object]
    tries: int = 0
    sent_at: float = 0.0
    progress_at: float = -1.0
    timer: IDelayedCall | None = None

    @property
    def is_counted(self) -> bool:
        """Whether the request counts towards ``MAX_IN_FLIGHT``; fragments have their own congestion window."""
        return not (self.has_long_timeout or self.is_fragmented)


class Requester:
    """The outgoing requests of an endpoint; ``send`` is called with a session and the bytes of a message."""

    def __init__(
        self,
        clock: IReactorTime,
        rng: random.Random,
        peers: Peers,
        fragmenter: Fragmenter,
        send: Callable[[Session, bytes], None],
        counters: Counter[str],
    ) -> None:
        self._clock = clock
        self._peers = peers
        self._send = send
        self._counters = counters
        self._fragmenter = fragmenter
        self._requests: dict[int, PendingRequest] = {}
        self._queued = 0
        # The random start within 62 bits separates the request ids of a restarted node from its earlier request ids.
        self._next_number = rng.getrandbits(62)
        peers.on_handshake_failed.add(self._fail_unanswered)

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
            peer = self._peers.get_or_create(contact)
        except ValueError:
            return defer.fail(NoAnswer(f"{contact.address}: the public key of this contact is invalid"))
        try:
            message = encode(Request(number, method, arguments, behind=number - peer.oldest_request(number)))
        except (TypeError, ValueError, OverflowError) as error:
            return defer.fail(error)
        if len(message) > MAX_MESSAGE_BYTES:
            return defer.fail(TooLarge(_format_too_large(method, message, MAX_MESSAGE_BYTES)))
        if self._queued >= MAX_QUEUED:
            self._counters["crowded"] += 1
            return defer.fail(Crowded(f"{method} asked of {contact.address}: {_FULL_TEXT}"))
        is_bulky = len(message) > MAX_PLAIN_BYTES
        if is_bulky and not self._fragmenter.reserve(contact.public, len(message)):
            return defer.fail(Crowded(f"{method} asked of {contact.address}: {_FULL_TEXT}"))
        self._next_number += 1
        now = self._clock.seconds()
        timeout_s = TIMEOUT_S if timeout is None else timeout
        deferred: Deferred[object] = Deferred(lambda _: self._cancel(request))
        request = PendingRequest(
            number=number,
            method=method,
            peer=peer,
            address=contact.address,
            message=message,
            changes=changes,
            created_at=now,
            deadline=now + timeout_s,
            has_long_timeout=timeout_s > TIMEOUT_S,
            is_fragmented=is_bulky,
            avoids_handshake=is_light,
            extension_s=TIMEOUT_S if timeout is None else 0.0,
            deferred=deferred,
        )
        is_open = (
            self._peers.find_usable_session(peer) is not None
        )  # this must be evaluated before the request marks the session as in use
        self._requests[number] = request
        peer.add_request(number)
        if is_open and (peer.in_flight < MAX_IN_FLIGHT or not request.is_counted):
            self._send_request(request)
            return deferred
        peer.enqueue(number)
        self._queued += 1
        self._set_timer(request, timeout_s)
        if not is_open and not self._open_session(request):
            self._fail(request, _HANDSHAKES_TEXT)
        return deferred

    def notify(self, contact: Contact, method: str, arguments: tuple[object, ...]) -> None:
        """Send a notification; see ``Endpoint.notify``."""
        message = encode(Notification(method, arguments))
        if len(message) > MAX_PLAIN_BYTES:
            raise TooLarge(_format_too_large(method, message, MAX_PLAIN_BYTES))
        try:
            peer = self._peers.get_or_create(contact)
        except ValueError:
            self._counters["untold"] += 1
            return
        session = self._peers.find_usable_session(peer)
        if session is not None:
            self._send(session, message)
            if self._clock.seconds() - session.last_received_at > SILENCE_S:
                # A notification has no answer: without this handshake a restart of the peer would go unnoticed.
                self._peers.open(peer, contact.address)
        elif len(peer.notifications) < MAX_NOTIFICATIONS and (
            peer.handshake is not None or self._peers.open(peer, contact.address)
        ):
            peer.notifications += (message,)
        else:
            self._counters["untold"] += 1

    def stop(self, error: Exception) -> None:
        """Cancel every timer and fail every request with ``error``."""
        self._fail_all(list(self._requests.values()), lambda: error)

    def fail_requests(self, peer: Peer, error: Callable[[], Exception]) -> None:
        """Fail every request to a peer, because one of the two nodes rejects the other."""
        self._counters["untold"] += len(peer.notifications)
        peer.notifications = ()
        self._fail_all(self._requests_to(peer), error)

    def is_pending(self, number: int, public: bytes) -> bool:
        """Return whether the request ``number`` waits for an answer from the peer with that key."""
        request = self._requests.get(number)
        return request is not None and request.peer.public == public

    def record_progress(self, number: int, public: bytes) -> None:
        """Record that the peer acknowledged a fragment of a request, or that a fragment of its answer arrived."""
        if self.is_pending(number, public):
            request = self._requests[number]
            request.progress_at = self._clock.seconds()
            request.deadline = max(request.deadline, request.progress_at + request.extension_s)

    def resolve(self, message: Answer | Failure, public: bytes) -> None:
        """Pass an answer to the caller of its request; count the answer if no request waits for it."""
        request = self._requests.get(message.id)
        if request is None or request.peer.public != public:
            self._counters["unasked"] += 1
            return
        is_timed = request.tries > 0 and request.progress_at < 0 and not request.is_fragmented
        if is_timed:  # otherwise the measured time would include the handshake or the transfer
            self._peers.record_answer(request.peer, request.tries, self._clock.seconds() - request.sent_at)
        self._forget(request)
        if isinstance(message, Answer):
            request.deferred.callback(message.value)
        else:
            request.deferred.errback(make_error(message))

    def send_waiting(self, peer: Peer, session: Session, is_owed: bool) -> None:
        """Send the messages that waited for a session; ``is_owed``: the peer waits for a datagram in this session."""
        sent = 0
        for message in peer.notifications:
            self._send(session, message)
            sent += 1
        peer.notifications = ()
        if is_owed:  # the peer may have lost the session in which the other requests were sent
            for request in self._requests_to(peer):
                if request.tries:
                    self._send_request(request)
                    sent += 1
        sent += self._send_queued(peer)
        if is_owed and not sent:
            self._send(session, b"")

    def _send_request(self, request: PendingRequest) -> None:
        """Send a request in the peer's newest session and set its timer."""
        session = request.peer.sessions[-1]
        now = self._clock.seconds()
        request.tries += 1
        if request.tries == 1:
            request.sent_at = now
            request.peer.in_flight += request.is_counted
        message = set_remaining_time(request.message, request.deadline - now)
        if request.is_fragmented:
            self._fragmenter.send(request.peer.public, MessageKey(False, request.number), message)
        else:
            self._send(session, message)
        within = request.deadline - request.created_at
        wait = self._peers.retry_interval(request.peer.round_trip, request.tries, within)
        if request.has_long_timeout and request.tries > 1:
            # The method is slow: later retransmissions are needed only if the answer was lost.
            wait = max(wait, (request.deadline - now) / max(1, self._peers.tries + 1 - request.tries))
        self._set_timer(request, wait)

    def _on_timer(self, request: PendingRequest) -> None:
        """Retransmit a request, open a session for it, or fail it, when its timer fires."""
        now, peer = self._clock.seconds(), request.peer
        left = request.deadline - now
        if left <= 0 and request.number in peer.queue and peer.session is not None:
            # The request waits in the queue while the peer answers other requests; its delay does not mean that the
            # peer failed.
            left = min(peer.session.last_received_at, request.created_at + MAX_QUEUED_S) + request.extension_s - now
            if left <= 0:
                self._fail(request, _QUEUE_TIMEOUT_TEXT)
            else:
                request.deadline = now + left
                self._set_timer(request, left)
            return
        if left <= 0:
            self._fail(request, f"no answer in {now - request.created_at:.2f} s")
            return
        session = self._peers.find_usable_session(peer)
        is_silent = session is not None and session.last_received_at <= request.sent_at
        if session is None:
            if not self._open_session(request):
                self._fail(request, _HANDSHAKES_TEXT)
            else:
                self._set_timer(request, left)
        elif request.is_fragmented or request.progress_at >= 0:
            # The fragmenter retransmits fragments; a handshake is needed only if the peer lost the session.
            if is_silent or now - session.last_received_at > MAX_TIMEOUT_S:
                self._open_session(request)
            self._set_timer(request, MAX_TIMEOUT_S)
        elif request.tries >= self._peers.tries:
            is_opening = peer.handshake is not None and not peer.handshake.is_waiting
            if request.has_long_timeout or not is_silent or is_opening or not peer.round_trip.is_measured:
                self._set_timer(request, left)
            else:
                self._fail(request, f"no answer to {request.tries} tries")
        else:
            if is_silent and not request.avoids_handshake and request.tries >= self._peers.tries_before_check(peer):
                self._open_session(request)  # the peer may have restarted and lost the session
            self._send_request(request)

    def _send_queued(self, peer: Peer) -> int:
        """Send queued requests to a peer up to ``MAX_IN_FLIGHT``; return their number."""
        sent = 0
        while peer.queue and peer.in_flight < MAX_IN_FLIGHT and self._peers.find_usable_session(peer) is not None:
            request = self._requests[next(iter(peer.queue))]
            self._leave_queue(request)
            # If the caller gave no timeout, the time for the answer starts now.
            request.deadline = max(request.deadline, self._clock.seconds() + request.extension_s)
            self._send_request(request)
            sent += 1
        return sent

    def _leave_queue(self, request: PendingRequest) -> None:
        if request.number in request.peer.queue:
            request.peer.dequeue(request.number)
            self._queued -= 1

    def _requests_to(self, peer: Peer) -> list[PendingRequest]:
        return [self._requests[number] for number in peer.requests]

    def _open_session(self, request: PendingRequest) -> bool:
        """Open a session for a request, inside the INIT if allowed; return False if there are too many handshakes."""
        left = request.deadline - self._clock.seconds()
        early_message = b"" if request.changes else set_remaining_time(request.message, left)
        return self._peers.open(request.peer, request.address, early_message, within=min(left, HANDSHAKE_S))

    def _fail_unanswered(self, opening: OutgoingHandshake) -> None:
        """Fail the requests that waited for a handshake that got no answer."""
        peer = opening.peer
        self._counters["untold"] += len(peer.notifications)
        peer.notifications = ()
        if peer.sessions:
            for request in self._requests_to(peer):
                if request.tries >= self._peers.tries:  # this request waited only for the handshake
                    self._on_timer(request)
            return  # the remaining requests have their own timers
        for request in self._requests_to(peer):
            was_tried = request.created_at <= opening.started_at and request.address == opening.address
            if request.has_long_timeout or not was_tried:
                if not self._open_session(request):
                    self._fail(request, _HANDSHAKES_TEXT)
            else:
                self._fail(request, f"no answer to {opening.tries} handshakes")

    def _set_timer(self, request: PendingRequest, wait: float) -> None:
        cancel(request.timer)
        wait = max(0.0, min(wait, request.deadline - self._clock.seconds()))
        request.timer = self._clock.callLater(wait, self._on_timer, request)

    def _fail_all(self, requests: list[PendingRequest], error: Callable[[], Exception]) -> None:
        for request in requests:
            self._remove(request)
        for request in requests:
            request.deferred.errback(error())

    def _fail(self, request: PendingRequest, why: str) -> None:
        self._forget(request)
        kind = Crowded if why in (_HANDSHAKES_TEXT, _QUEUE_TIMEOUT_TEXT) else NoAnswer
        request.deferred.errback(kind(f"{request.method} asked of {request.address}: {why}"))

    def _cancel(self, request: PendingRequest) -> None:
        """Forget a request that its caller cancelled, and notify the peer."""
        self._forget(request)
        session = self._peers.find_usable_session(request.peer)
        if session is not None and request.tries:
            self._send(session, encode(Cancel(request.number)))

    def _forget(self, request: PendingRequest) -> None:
        """Remove a request and send the next queued one."""
        self._remove(request)
        self._send_queued(request.peer)

    def _remove(self, request: PendingRequest) -> None:
        cancel(request.timer)
        if self._requests.pop(request.number, None) is None:
            return
        request.peer.remove_request(request.number)
        self._leave_queue(request)
        if request.tries:
            request.peer.in_flight -= request.is_counted
        if request.is_fragmented:
            self._fragmenter.drop(request.peer.public, MessageKey(False, request.number))
            self._fragmenter.release(request.peer.public, len(request.message))
        if request.progress_at >= 0:
            self._fragmenter.forget_incoming(request.peer.public, MessageKey(True, request.number))


def _format_too_large(method: str, message: bytes, most: int) -> str:
    return f"{method}: the message has {len(message)} bytes, the limit is {most}; split or shorten it"
