"""Answerer: runs the exposed methods for peers, each change at most once, in time or not at all, and makes the answers.

It knows no keys and no sockets: it is handed questions, and callables that send a message on a session.
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

from middleware.entangled.bounded import keep
from middleware.entangled.contact import Contact
from middleware.entangled.token_bucket import TokenBucket
from middleware.entangled.wire.courier import Courier
from middleware.entangled.wire.door import ROLE, meaning
from middleware.entangled.wire.message import (
    BUSY,
    GONE,
    INTERNAL,
    MAX_MESSAGE,
    NO_LIMIT_MS,
    REFUSED,
    UNKNOWN_METHOD,
    Answer,
    Cancel,
    Failure,
    Key,
    Question,
    Told,
    encoded,
)
from middleware.entangled.wire.method import Entry, Ledger, Method, failure_of
from middleware.entangled.wire.session import MAX_PLAIN, Session

MAX_CANCELLED = 1024
# What one peer may ask in a second, and at once: several times what the busiest of a team does, a quarter of a core.
QUESTIONS, QUESTIONS_AT_ONCE = 2000.0, 8192.0
MAX_ASKING = 4096
_BUSY = "this node holds as many open questions as it may; ask again later"
_HASTY = "this peer asks more than this node can answer; ask again later, and less often"
_FULL = "too much is on its way to you already; ask again later"
_GONE = "the call ran, and its answer was too large to keep; ask what it changed"


class Answerer:
    """What peers may ask of this node; ``send`` is called with a session and the bytes of a message.

    ``may`` says whether a peer of that public key may call a method, ``refused`` is told of each that may not.
    """

    _log = Logger()

    def __init__(
        self,
        clock: IReactorTime,
        send: Callable[[Session, bytes], None],
        courier: Courier,
        counters: Counter[str],
        may: Callable[[bytes, str], bool],
        refused: Callable[[Contact, str], None],
    ) -> None:
        self.methods: dict[str, Method] = {}
        self._may = may
        self._refused = refused
        self._clock = clock
        self._send = send
        self._courier = courier
        self._counters = counters
        self._ledger = Ledger()
        self._cancelled: dict[tuple[bytes, int], None] = {}
        self._asking: dict[bytes, TokenBucket] = {}

    def clear(self) -> None:
        """Forget what was asked; answers that are still being made go nowhere."""
        self._ledger.clear()
        self._cancelled.clear()
        self._asking.clear()

    def evict(self, public: bytes) -> None:
        """Forget what a peer asked, and stop the work on it."""
        for work in self._ledger.evict(public):
            work.cancel()

    def tidy(self, now: float) -> None:
        """Forget how much those asked who ask so little that they may ask as much as anybody again."""
        for public in [public for public, bucket in self._asking.items() if bucket.is_full(now)]:
            del self._asking[public]

    def answer(self, question: Question, session: Session, is_bulky: bool = False) -> None:
        """Answer a question of an established session, now or when the method is done.

        ``is_bulky`` says that it came as a parcel.  Its answer then goes as one too, however short: a parcel is
        repeated by us, and the asker need not send the whole question again because a short answer got lost.
        """
        public = session.contact.public
        if (public, question.id) in self._cancelled:
            self._counters["cancelled"] += 1
            return
        method = self.methods.get(question.method)
        if method is not None and method.is_once:
            if self._ledger.is_settled(public, question.id):
                self._counters["late"] += 1
                return
            self._ledger.settle(public, question.id - question.behind, self._clock.seconds())
        entry = self._ledger.entry(public, question.id)
        is_known = entry is not None or self._courier.is_carrying(public, Key(True, question.id))
        if is_known:
            self._counters["repeated"] += 1
            if entry is not None and entry.answer is not None:
                self._reply(session, question.id, entry.answer, is_bulky)
            else:
                if entry is not None:
                    entry.session = session
                self._send(session, b"")  # a sign of life: the asker keeps waiting
            return
        if not question.left_ms:
            self._counters["late"] += 1
            return
        if not self._is_within(public):
            self._reply(session, question.id, self._busy(question.id, _HASTY), is_bulky)
            return
        answer = self._run(question, session.contact, session, is_bulky)
        if answer is not None:
            self._reply(session, question.id, answer, is_bulky)

    def ride(self, question: Question, peer: Contact, room: int) -> bytes:
        """The answer to a question that came with an INIT, or nothing where it must wait for the session.

        An INIT may be a recording, and its source address is not proved.  So only methods that were exposed as early
        run, nothing is remembered of the question, and an answer that takes its time or more than ``room`` is dropped.
        """
        method = self.methods.get(question.method)
        if method is None or not method.is_early or not question.left_ms:
            return b""
        if not self._may(peer.public, question.method) or self._ledger.entry(peer.public, question.id) is not None:
            return b""
        result = self._called(method, peer, question.arguments, math.inf)
        if isinstance(result, Deferred):
            result.addErrback(lambda trouble: None)
            result.cancel()
            return b""
        answer = self._worded(method, question.id, result)
        return answer if len(answer) <= room else b""

    def take(self, told: Told, peer: Contact) -> None:
        """Run what a peer told us; it hears nothing back."""
        method = self.methods.get(told.method)
        if not self._is_within(peer.public):
            self._counters["busy"] += 1
            return
        if method is None:
            self._counters["unknown method"] += 1
            return
        if not self._may(peer.public, told.method):
            self._refuse(peer, told.method)
            return
        result = self._called(method, peer, told.arguments, math.inf)
        if isinstance(result, Deferred):
            result.addErrback(lambda trouble: self._told_no(method, trouble))
        elif isinstance(result, Trouble):
            self._told_no(method, result)

    def cancel(self, message: Cancel, public: bytes) -> None:
        """Stop the work on a question for which nobody waits any more, and do not begin it if it comes later."""
        self._courier.drop(public, Key(True, message.id))
        self._courier.forget(public, Key(False, message.id))
        entry = self._ledger.entry(public, message.id)
        if entry is None:
            keep(self._cancelled, (public, message.id), None, MAX_CANCELLED)
        elif entry.work is not None:
            self._counters["cancelled"] += 1
            self._stop(entry)

    def _run(self, question: Question, peer: Contact, session: Session, is_bulky: bool) -> bytes | None:
        """Run a new question; the answer, or None where it comes later."""
        method = self.methods.get(question.method)
        if method is None:
            return encoded(Failure(question.id, UNKNOWN_METHOD, f"{question.method}: no such method here"))
        if not self._may(peer.public, question.method):
            self._refuse(peer, question.method)
            return encoded(Failure(question.id, ROLE, f"{question.method}: {meaning(ROLE)}"))
        public, entry, now = peer.public, None, self._clock.seconds()
        if method.is_once:
            entry = self._ledger.begin(public, question.id, session, now, is_bulky)
            if entry is None:
                return self._busy(question.id)
        deadline = math.inf if question.left_ms == NO_LIMIT_MS else now + question.left_ms / 1000
        result = self._called(method, peer, question.arguments, deadline)
        if isinstance(result, Deferred):
            early: list[object] = []
            is_late = False

            def arrived(outcome: object) -> None:
                if is_late:
                    self._finish(outcome, method, question.id, public, entry)
                else:
                    early.append(outcome)

            result.addBoth(arrived)
            if not early:
                is_late = True
                if entry is None:
                    entry = self._ledger.begin(public, question.id, session, now, is_bulky)
                if entry is None:
                    result.cancel()
                    return self._busy(question.id)
                entry.work = result
                if deadline < math.inf:
                    entry.timer = self._clock.callLater(deadline - now, self._too_late, entry)
                return None
            result = early[0]
        answer = self._worded(method, question.id, result)
        if entry is not None:
            self._ledger.end(public, question.id, _kept(question.id, answer), self._clock.seconds())
        return answer

    def _finish(self, result: object, method: Method, number: int, public: bytes, entry: Entry | None) -> None:
        answer = self._worded(method, number, result)
        if entry is None or self._ledger.entry(public, number) is not entry:
            return  # it was turned away, or the node stopped meanwhile
        session = entry.session
        kept = _kept(number, answer) if method.is_once else None
        self._ledger.end(public, number, kept, self._clock.seconds())
        if session is not None:
            self._reply(session, number, answer, entry.is_bulky)

    def _reply(self, session: Session, number: int, answer: bytes, is_bulky: bool) -> None:
        """Send an answer, as a parcel where it must be one."""
        if len(answer) <= MAX_PLAIN and not is_bulky:
            self._send(session, answer)
        elif not self._courier.post(session.contact.public, Key(True, number), answer):
            self._send(session, encoded(Failure(number, BUSY, _FULL)))

    def _too_late(self, entry: Entry) -> None:
        self._counters["late"] += 1
        self._stop(entry)

    def _stop(self, entry: Entry) -> None:
        """Cancel the work on a question; its outcome goes nowhere."""
        work, entry.session = entry.work, None
        if work is not None:
            work.cancel()

    def _refuse(self, peer: Contact, method: str) -> None:
        self._counters["refused"] += 1
        self._refused(peer, method)

    def _busy(self, number: int, text: str = _BUSY) -> bytes:
        self._counters["busy"] += 1
        return encoded(Failure(number, BUSY, text))

    def _is_within(self, public: bytes) -> bool:
        """Whether a peer may ask one thing more now."""
        bucket = self._asking.get(public) or TokenBucket(QUESTIONS, QUESTIONS_AT_ONCE)
        keep(self._asking, public, bucket, MAX_ASKING)
        return bucket.take(self._clock.seconds())

    def _called(self, method: Method, peer: Contact, arguments: tuple[object, ...], deadline: float) -> object:
        """What the method returned, a Deferred for a coroutine, or the trouble it raised."""
        try:
            result = method.run(peer, arguments, deadline)
        except Exception:  # the method is the owner's code, not ours
            return Trouble()
        return Deferred.fromCoroutine(result) if inspect.iscoroutine(result) else result

    def _worded(self, method: Method, number: int, result: object) -> bytes:
        """The bytes that tell the asker the result of a method, good or bad."""
        if isinstance(result, Trouble):
            known = failure_of(number, result)
            if known is not None:
                return encoded(known)
            self._log.failure("{method} failed for a peer", failure=result, method=method.name)
            return encoded(Failure(number, INTERNAL, "internal error"))
        try:
            answer = encoded(Answer(number, result))
        except (TypeError, ValueError, OverflowError) as error:
            self._log.error("{method} returned what cannot be sent: {error}", method=method.name, error=error)
            return encoded(Failure(number, INTERNAL, "internal error"))
        if len(answer) > MAX_MESSAGE:
            text = f"{method.name}: the answer has {len(answer)} bytes, {MAX_MESSAGE} can be sent; ask for less"
            return encoded(Failure(number, REFUSED, text))
        return answer

    def _told_no(self, method: Method, trouble: Trouble) -> None:
        if failure_of(0, trouble) is not None:
            self._counters["refused"] += 1
        else:
            self._log.failure("{method} failed for a peer", failure=trouble, method=method.name)


def _kept(number: int, answer: bytes) -> bytes:
    """What is kept of an answer for those who ask again."""
    return answer if len(answer) <= MAX_PLAIN else encoded(Failure(number, GONE, _GONE))
