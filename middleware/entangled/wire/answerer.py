"""Answerer: runs the exposed methods for peers, each change at most once, and makes the answers.

It knows no keys and no sockets: it is handed questions, and a callable that sends a message on a session.
"""

from __future__ import annotations

import inspect
from collections import Counter
from collections.abc import Callable

from twisted.internet.defer import Deferred
from twisted.internet.interfaces import IReactorTime
from twisted.logger import Logger
from twisted.python.failure import Failure as Trouble

from middleware.entangled.errors import Refused
from middleware.entangled.kademlia.contact import Contact
from middleware.entangled.wire.ledger import Entry, Ledger
from middleware.entangled.wire.message import (
    BAD_ARGUMENTS,
    INTERNAL,
    REFUSED,
    UNKNOWN_METHOD,
    Answer,
    Failure,
    Question,
    Told,
    encoded,
)
from middleware.entangled.wire.method import BadArguments, Method
from middleware.entangled.wire.session import MAX_MESSAGE, Session

_BUSY = "this node holds as many open questions as it may; ask again later"


class Answerer:
    """What peers may ask of this node; ``send`` is called with a session and the bytes of a message."""

    _log = Logger()

    def __init__(self, clock: IReactorTime, send: Callable[[Session, bytes], None], counters: Counter[str]) -> None:
        self.methods: dict[str, Method] = {}
        self._clock = clock
        self._send = send
        self._counters = counters
        self._ledger = Ledger()

    def clear(self) -> None:
        """Forget what was asked; answers that are still being made go nowhere."""
        self._ledger.clear()

    def answer(self, question: Question, session: Session) -> None:
        """Answer a question of an established session, now or when the method is done."""
        public = session.contact.public
        entry = self._ledger.entry(public, question.id)
        if entry is not None:
            self._counters["repeated"] += 1
            if entry.answer is None:
                entry.session = session
                self._send(session, b"")  # a sign of life: the asker keeps waiting
            else:
                self._send(session, entry.answer)
            return
        answer = self._run(question, session.contact, session)
        if answer is not None:
            self._send(session, answer)

    def ride(self, question: Question, peer: Contact, room: int) -> bytes:
        """The answer to a question that came with a handshake, or nothing where it must wait for the session.

        It must wait where it changes something (a handshake may be a replay), takes its time, or needs more ``room``.
        """
        method = self.methods.get(question.method)
        if (method is not None and method.changes) or self._ledger.entry(peer.public, question.id) is not None:
            return b""
        answer = self._run(question, peer, None)
        return answer if answer is not None and len(answer) <= room else b""

    def take(self, told: Told, peer: Contact) -> None:
        """Run what a peer told us; it hears nothing back."""
        method = self.methods.get(told.method)
        if method is None:
            self._counters["unknown method"] += 1
            return
        result = self._called(method, peer, told.arguments)
        if isinstance(result, Deferred):
            result.addErrback(lambda trouble: self._told_no(method, trouble))
        elif isinstance(result, Trouble):
            self._told_no(method, result)

    def _run(self, question: Question, peer: Contact, session: Session | None) -> bytes | None:
        """Run a new question; the answer, or None where it comes later."""
        method = self.methods.get(question.method)
        if method is None:
            return encoded(Failure(question.id, UNKNOWN_METHOD, f"{question.method}: no such method here"))
        public, entry = peer.public, None
        if method.changes:
            entry = self._ledger.begin(public, question.id, session, self._clock.seconds())
            if entry is None:
                self._counters["busy"] += 1
                return encoded(Failure(question.id, REFUSED, _BUSY))
        result = self._called(method, peer, question.arguments)
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
                    entry = self._ledger.begin(public, question.id, session, self._clock.seconds())
                if entry is None:
                    self._counters["busy"] += 1
                    return encoded(Failure(question.id, REFUSED, _BUSY))
                return None
            result = early[0]
        answer = self._worded(method, question.id, result)
        if entry is not None:
            self._ledger.end(public, question.id, answer, self._clock.seconds())
        return answer

    def _finish(self, result: object, method: Method, number: int, public: bytes, entry: Entry | None) -> None:
        answer = self._worded(method, number, result)
        if entry is None or self._ledger.entry(public, number) is not entry:
            return  # it was turned away, or the node stopped meanwhile
        session = entry.session
        self._ledger.end(public, number, answer if method.changes else None, self._clock.seconds())
        if session is not None:
            self._send(session, answer)

    def _called(self, method: Method, peer: Contact, arguments: tuple[object, ...]) -> object:
        """What the method returned, a Deferred for a coroutine, or the trouble it raised."""
        try:
            result = method.run(peer, arguments)
        except Exception:  # the method is the owner's code, not ours
            return Trouble()
        return Deferred.fromCoroutine(result) if inspect.iscoroutine(result) else result

    def _worded(self, method: Method, number: int, result: object) -> bytes:
        """The bytes that tell the asker the result of a method, good or bad."""
        if isinstance(result, Trouble):
            if isinstance(result.value, Refused):
                code = BAD_ARGUMENTS if isinstance(result.value, BadArguments) else REFUSED
                return encoded(Failure(number, code, str(result.value)))
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
        if isinstance(trouble.value, Refused):
            self._counters["refused"] += 1
        else:
            self._log.failure("{method} failed for a peer", failure=trouble, method=method.name)
