"""Run exposed methods for peers and send the answers; a method with side effects runs at most once per request.

The dispatcher has no access to keys or sockets: it receives decoded requests, and callables that send a message in a
session.
"""

from __future__ import annotations

import inspect
import math
from collections import Counter
from collections.abc import Callable

from twisted.internet.defer import Deferred
from twisted.internet.interfaces import IReactorTime
from twisted.logger import Logger
from twisted.python.failure import Failure as Trouble

from middleware.entangled.bounded import put_bounded
from middleware.entangled.contact import Contact
from middleware.entangled.token_bucket import TokenBucket
from middleware.entangled.wire.admission_check import ROLE, explain
from middleware.entangled.wire.fragmenter import Fragmenter
from middleware.entangled.wire.message import (
    BUSY,
    GONE,
    INTERNAL,
    MAX_MESSAGE_BYTES,
    NO_LIMIT_MS,
    REFUSED,
    UNKNOWN_METHOD,
    Answer,
    Cancel,
    Failure,
    MessageKey,
    Notification,
    Request,
    encode,
)
from middleware.entangled.wire.method import Method, RequestEntry, RequestHistory, make_failure
from middleware.entangled.wire.session import MAX_PLAIN_BYTES, Session

MAX_CANCELLED = 1024
# The number of requests that one peer may send per second, and in one burst.  The rate is several times that of the
# busiest node of a team, and takes about a quarter of a CPU core.
REQUESTS_PER_S, REQUEST_BURST = 2000.0, 8192.0
MAX_REQUESTERS = 4096
_BUSY_TEXT = "the peer has too many open requests of this node; try again later"
_RATE_LIMITED_TEXT = "this node sends more requests per second than the peer accepts; send fewer, and try again later"
_FULL_TEXT = "the peer already sends the maximum number of bytes to this node; try again later"
_GONE_TEXT = "the call ran, but its answer was too large to store; read the state that the call changed"


class Dispatcher:
    """Dispatches requests of peers to exposed methods; ``send`` is called with a session and the bytes of a message.

    ``may_call`` returns whether a peer (its public key) may call a method; ``on_refused_call`` is called for each
    rejected call.
    """

    _log = Logger()

    def __init__(
        self,
        clock: IReactorTime,
        send: Callable[[Session, bytes], None],
        fragmenter: Fragmenter,
        counters: Counter[str],
        may_call: Callable[[bytes, str], bool],
        on_refused_call: Callable[[Contact, str], None],
    ) -> None:
        self.methods: dict[str, Method] = {}
        self._may_call = may_call
        self._on_refused_call = on_refused_call
        self._clock = clock
        self._send = send
        self._fragmenter = fragmenter
        self._counters = counters
        self._history = RequestHistory()
        self._cancelled: dict[tuple[bytes, int], None] = {}
        self._rate_limits: dict[bytes, TokenBucket] = {}

    def clear(self) -> None:
        """Forget all requests; the answers of running methods are discarded."""
        self._history.clear()
        self._cancelled.clear()
        self._rate_limits.clear()

    def evict(self, public: bytes) -> None:
        """Forget the requests of a peer, and cancel those that are running."""
        for work in self._history.evict(public):
            work.cancel()

    def delete_full_limiters(self, now: float) -> None:
        """Delete the rate limiters of peers that used no tokens lately: those that are full at the time ``now``."""
        for public in [public for public, bucket in self._rate_limits.items() if bucket.is_full(now)]:
            del self._rate_limits[public]

    def dispatch(self, request: Request, session: Session, is_bulky: bool = False) -> None:
        """Answer a request of an established session, immediately or when its method is done.

        ``is_bulky``: the request arrived in fragments.  Its answer is then also sent in fragments, even if it is short.
        The responder retransmits lost fragments, so the requester need not repeat the whole request when an answer is
        lost.
        """
        public = session.contact.public
        if (public, request.id) in self._cancelled:
            self._counters["cancelled"] += 1
            return
        method = self.methods.get(request.method)
        if method is not None and method.runs_once:
            if self._history.is_settled(public, request.id):
                self._counters["late"] += 1
                return
            self._history.forget_before(public, request.id - request.behind, self._clock.seconds())
        entry = self._history.get(public, request.id)
        is_known = entry is not None or self._fragmenter.is_sending(public, MessageKey(True, request.id))
        if is_known:
            self._counters["repeated"] += 1
            if entry is not None and entry.answer is not None:
                self._reply(session, request.id, entry.answer, is_bulky)
            else:
                if entry is not None:
                    entry.session = session
                self._send(session, b"")  # a keep-alive: the requester continues to wait
            return
        if not request.left_ms:
            self._counters["late"] += 1
            return
        if not self._take_token(public):
            self._reply(session, request.id, self._fail_busy(request.id, _RATE_LIMITED_TEXT), is_bulky)
            return
        answer = self._run(request, session.contact, session, is_bulky)
        if answer is not None:
            self._reply(session, request.id, answer, is_bulky)

    def answer_early(self, request: Request, peer: Contact, room: int) -> bytes:
        """Return the encoded answer to a request in an INIT; empty if the request has to wait for the session.

        An INIT may be replayed, and its source address is not verified. Therefore only methods that were exposed with
        ``early`` run, no state is kept, and an answer that is not available immediately or exceeds ``room`` bytes is
        dropped.
        """
        method = self.methods.get(request.method)
        if method is None or not method.is_early or not request.left_ms:
            return b""
        if not self._may_call(peer.public, request.method) or self._history.get(peer.public, request.id) is not None:
            return b""
        result = self._call_method(method, peer, request.arguments, math.inf)
        if isinstance(result, Deferred):
            result.addErrback(lambda failure: None)
            result.cancel()
            return b""
        answer = self._encode_result(method, request.id, result)
        return answer if len(answer) <= room else b""

    def run_notification(self, notification: Notification, peer: Contact) -> None:
        """Run the method of a notification; send no answer."""
        method = self.methods.get(notification.method)
        if not self._take_token(peer.public):
            self._counters["busy"] += 1
            return
        if method is None:
            self._counters["unknown method"] += 1
            return
        if not self._may_call(peer.public, notification.method):
            self._refuse(peer, notification.method)
            return
        result = self._call_method(method, peer, notification.arguments, math.inf)
        if isinstance(result, Deferred):
            result.addErrback(lambda failure: self._log_notification_error(method, failure))
        elif isinstance(result, Trouble):
            self._log_notification_error(method, result)

    def cancel(self, message: Cancel, public: bytes) -> None:
        """Cancel the work on a request that the peer cancelled; if the request arrives later, it is not executed."""
        self._fragmenter.drop(public, MessageKey(True, message.id))
        self._fragmenter.forget_incoming(public, MessageKey(False, message.id))
        entry = self._history.get(public, message.id)
        if entry is None:
            put_bounded(self._cancelled, (public, message.id), None, MAX_CANCELLED)
        elif entry.work is not None:
            self._counters["cancelled"] += 1
            self._stop(entry)

    def _run(self, request: Request, peer: Contact, session: Session, is_bulky: bool) -> bytes | None:
        """Run a new request; return its encoded answer, or None if the answer comes later."""
        method = self.methods.get(request.method)
        if method is None:
            return encode(Failure(request.id, UNKNOWN_METHOD, f"{request.method}: no such method here"))
        if not self._may_call(peer.public, request.method):
            self._refuse(peer, request.method)
            return encode(Failure(request.id, ROLE, f"{request.method}: {explain(ROLE)}"))
        public, entry, now = peer.public, None, self._clock.seconds()
        if method.runs_once:
            entry = self._history.begin(public, request.id, session, now, is_bulky)
            if entry is None:
                return self._fail_busy(request.id)
        deadline = math.inf if request.left_ms == NO_LIMIT_MS else now + request.left_ms / 1000
        result = self._call_method(method, peer, request.arguments, deadline)
        if isinstance(result, Deferred):
            early: list[object] = []
            is_late = False

            def arrived(outcome: object) -> None:
                if is_late:
                    self._finish(outcome, method, request.id, public, entry)
                else:
                    early.append(outcome)

            result.addBoth(arrived)
            if not early:
                is_late = True
                if entry is None:
                    entry = self._history.begin(public, request.id, session, now, is_bulky)
                if entry is None:
                    result.cancel()
                    return self._fail_busy(request.id)
                entry.work = result
                if deadline < math.inf:
                    entry.timer = self._clock.callLater(deadline - now, self._expire, entry)
                return None
            result = early[0]
        answer = self._encode_result(method, request.id, result)
        if entry is not None:
            self._history.finish(public, request.id, _limit_kept_answer(request.id, answer), self._clock.seconds())
        return answer

    def _finish(self, result: object, method: Method, number: int, public: bytes, entry: RequestEntry | None) -> None:
        answer = self._encode_result(method, number, result)
        if entry is None or self._history.get(public, number) is not entry:
            return  # while the method ran, the peer was evicted or the node stopped
        session = entry.session
        kept_answer = _limit_kept_answer(number, answer) if method.runs_once else None
        self._history.finish(public, number, kept_answer, self._clock.seconds())
        if session is not None:
            self._reply(session, number, answer, entry.is_fragmented)

    def _reply(self, session: Session, number: int, answer: bytes, is_bulky: bool) -> None:
        """Send an answer, in fragments if it is bulky or larger than a datagram."""
        if len(answer) <= MAX_PLAIN_BYTES and not is_bulky:
            self._send(session, answer)
        elif not self._fragmenter.send(session.contact.public, MessageKey(True, number), answer):
            self._send(session, encode(Failure(number, BUSY, _FULL_TEXT)))

    def _expire(self, entry: RequestEntry) -> None:
        self._counters["late"] += 1
        self._stop(entry)

    def _stop(self, entry: RequestEntry) -> None:
        """Cancel the work on a request and discard its result."""
        work, entry.session = entry.work, None
        if work is not None:
            work.cancel()

    def _refuse(self, peer: Contact, method: str) -> None:
        self._counters["refused"] += 1
        self._on_refused_call(peer, method)

    def _fail_busy(self, number: int, text: str = _BUSY_TEXT) -> bytes:
        self._counters["busy"] += 1
        return encode(Failure(number, BUSY, text))

    def _take_token(self, public: bytes) -> bool:
        """Return whether a peer's rate limit allows one more request now."""
        bucket = self._rate_limits.get(public) or TokenBucket(REQUESTS_PER_S, REQUEST_BURST)
        put_bounded(self._rate_limits, public, bucket, MAX_REQUESTERS)
        return bucket.take(self._clock.seconds())

    def _call_method(self, method: Method, peer: Contact, arguments: tuple[object, ...], deadline: float) -> object:
        """Return the method's result, a Deferred for a coroutine, or a Failure for an exception."""
        try:
            result = method.run(peer, arguments, deadline)
        except Exception:  # application code may raise anything
            return Trouble()
        return Deferred.fromCoroutine(result) if inspect.iscoroutine(result) else result

    def _encode_result(self, method: Method, number: int, result: object) -> bytes:
        """Encode the result of a method, or the error that it raised, as an answer."""
        if isinstance(result, Trouble):
            known = make_failure(number, result)
            if known is not None:
                return encode(known)
            self._log.failure("{method} failed for a peer", failure=result, method=method.name)
            return encode(Failure(number, INTERNAL, "internal error"))
        try:
            answer = encode(Answer(number, result))
        except (TypeError, ValueError, OverflowError) as error:
            self._log.error(
                "{method} returned a value that cannot be encoded: {error}", method=method.name, error=error
            )
            return encode(Failure(number, INTERNAL, "internal error"))
        if len(answer) > MAX_MESSAGE_BYTES:
            text = f"{method.name}: the answer has {len(answer)} bytes, the limit is {MAX_MESSAGE_BYTES}; request less"
            return encode(Failure(number, REFUSED, text))
        return answer

    def _log_notification_error(self, method: Method, failure: Trouble) -> None:
        if make_failure(0, failure) is not None:
            self._counters["refused"] += 1
        else:
            self._log.failure("{method} failed for a peer", failure=failure, method=method.name)


def _limit_kept_answer(number: int, answer: bytes) -> bytes:
    """Return what to store for repeated requests: the answer, or a failure if the answer is too large to store."""
    return answer if len(answer) <= MAX_PLAIN_BYTES else encode(Failure(number, GONE, _GONE_TEXT))
