"""Check arguments and run exposed methods, remember the calls that ran, and convert errors to failures and back.

``RequestHistory`` prevents a repeated request from running twice.  The requester receives an error of a method as
``Refused``, with the code and the text of the error.
"""

from __future__ import annotations

import inspect
import math
import re
import types
import typing
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple
from weakref import WeakKeyDictionary

from twisted.internet.defer import CancelledError, Deferred
from twisted.internet.interfaces import IDelayedCall
from twisted.python.failure import Failure as Trouble

from middleware.entangled.background import cancel
from middleware.entangled.contact import Contact
from middleware.entangled.errors import Refused
from middleware.entangled.wire.message import BAD_ARGUMENTS, CANCELLED, Failure, is_code
from middleware.entangled.wire.session import Session

KEEP_ANSWER_S = 30.0
MAX_PER_PEER = 4096
SEQUENCE_BITS = 32
"""The low bits of a request id, which a requester increments; the bits above are random and new after each restart."""
MAX_INCARNATIONS = 4
"""``lowest_open`` is stored for this number of restarts of one peer within ``KEEP_ANSWER_S``."""
MAX_ENTRIES = 16384
MAX_REQUESTERS = 4096
_PLAIN_TYPES = (int, float, bool, str, bytes, list, dict, type(None))
_TYPES_BY_NAME: dict[str, tuple[type, ...]] = {kind.__name__: (kind,) for kind in _PLAIN_TYPES}
_TYPES_BY_NAME |= {"None": (type(None),), "float": (float, int)}
_TYPE_ARGUMENTS = re.compile(r"\[[^\[\]]*\]")


class BadArguments(Refused):
    """The number or the types of the arguments do not match the method."""

    code = BAD_ARGUMENTS


class _Signature(NamedTuple):
    """The parameters of a function after the peer: number, types (None: any), and whether it has ``deadline``."""

    min_arguments: int
    max_arguments: float
    types: tuple[tuple[type, ...] | None, ...]
    wants_deadline: bool


_SIGNATURES: WeakKeyDictionary[Callable[..., object], _Signature] = WeakKeyDictionary()
"""A cache of the parameters of methods of classes, which are the same for all nodes of a process."""


@dataclass(frozen=True, slots=True)
class Method:
    """An exposed function.

    ``changes``: the function has side effects and runs once per request.  ``is_idempotent``: a second run does no harm,
    so the first run need not be remembered.  ``is_early``: the function only reads and returns immediately, so it may
    run before the peer has confirmed the session; every other function runs only in an established session.

    A keyword-only parameter ``deadline`` of the function receives the time on the node's clock after which the answer
    is useless.
    """

    name: str
    answer: Callable[..., object]
    changes: bool = False
    is_idempotent: bool = False
    is_early: bool = False
    _cached_signature: _Signature | None = field(default=None, init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if self.is_early and self.changes:
            raise ValueError(f"{self.name}: a method that changes something cannot be early")

    @property
    def _signature(self) -> _Signature:
        """The parameters, inspected at the first call, because inspecting all methods would double the start time."""
        form = self._cached_signature
        if form is None:
            answer = inspect.unwrap(self.answer)
            function = answer.__func__ if isinstance(answer, types.MethodType) else None
            form = _SIGNATURES.get(function) if function is not None else None
            if form is None:
                form = self._inspect()
                if function is not None:
                    _SIGNATURES[function] = form
            object.__setattr__(self, "_cached_signature", form)
        return form

    def _inspect(self) -> _Signature:
        signature = inspect.signature(self.answer)
        positional = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
        parameters = [parameter for parameter in signature.parameters.values() if parameter.kind in positional]
        is_open = any(p.kind is inspect.Parameter.VAR_POSITIONAL for p in signature.parameters.values())
        required = sum(1 for parameter in parameters if parameter.default is inspect.Parameter.empty)
        deadline = signature.parameters.get("deadline")
        return _Signature(
            max(0, required - 1),  # the first parameter is the peer
            math.inf if is_open else len(parameters) - 1,
            self._find_types(parameters[1:]),
            deadline is not None and deadline.kind is inspect.Parameter.KEYWORD_ONLY,
        )

    def _find_types(self, parameters: list[inspect.Parameter]) -> tuple[tuple[type, ...] | None, ...]:
        """Return the types that the annotations allow; annotations that are plain names are not evaluated."""
        named = [_types_in_annotation(parameter.annotation) for parameter in parameters]
        if all(named):
            return tuple(named)
        try:
            hints = typing.get_type_hints(self.answer)
        except Exception:  # annotations may raise anything: names imported for type checkers only, partials, callables
            hints = {}
        return tuple(_types_of_hint(hints.get(parameter.name)) for parameter in parameters)

    @property
    def runs_once(self) -> bool:
        """Whether the function may run only once per request."""
        return self.changes and not self.is_idempotent

    def run(self, peer: Contact, arguments: tuple[object, ...], deadline: float = math.inf) -> object:
        """Call the function; raise ``BadArguments`` if the arguments do not match, or the function's exception."""
        least, most, all_kinds, wants_deadline = self._signature
        if not least <= len(arguments) <= most:
            count = f"{least}" if least == most else f"{least} to {most}"
            raise BadArguments(f"{self.name}: the method takes {count} arguments, not {len(arguments)}")
        for place, (kinds, argument) in enumerate(zip(all_kinds, arguments, strict=False), start=1):
            if kinds is not None and type(argument) not in kinds:
                wanted = " or ".join("None" if kind is type(None) else kind.__name__ for kind in kinds)
                raise BadArguments(f"{self.name}: argument {place} must be {wanted}, not {type(argument).__name__}")
        if wants_deadline:
            return self.answer(peer, *arguments, deadline=deadline)
        return self.answer(peer, *arguments)


def _types_in_annotation(annotation: object) -> tuple[type, ...]:
    """Return the plain types named in an annotation; none if it is not a string or names any other type."""
    if not isinstance(annotation, str):
        return ()
    while (bare := _TYPE_ARGUMENTS.sub("", annotation)) != annotation:
        annotation = bare
    kinds = [_TYPES_BY_NAME.get(name.strip(), ()) for name in annotation.split("|")]
    return sum(kinds, ()) if all(kinds) else ()


def _types_of_hint(hint: object) -> tuple[type, ...] | None:
    """Return the plain types that a type hint allows, or None if plain types cannot express it."""
    origin = typing.get_origin(hint)
    if origin in (typing.Union, types.UnionType):
        kinds: list[type] = []
        for part in typing.get_args(hint):
            inner = _types_of_hint(part)
            if inner is None:
                return None
            kinds += inner
        return tuple(kinds)
    plain = origin or hint
    if plain is float:
        return (float, int)
    return (plain,) if plain in _PLAIN_TYPES else None


def make_failure(number: int, failure: Trouble) -> Failure | None:
    """Return the failure that reports an error to the requester of ``number``; None for an internal error."""
    error = failure.value
    if isinstance(error, Refused):
        return Failure(number, error.code if is_code(error.code) else Refused.code, str(error))
    if isinstance(error, CancelledError):
        return Failure(number, CANCELLED, "the call was cancelled")
    return None


def make_error(failure: Failure) -> Refused:
    """Return the exception that a failure represents."""
    return BadArguments(failure.text) if failure.code == BAD_ARGUMENTS else Refused(failure.text, failure.code)


@dataclass(slots=True)
class RequestEntry:
    """One request; ``answer`` is None while its method runs, and is sent in ``session`` (None: it is discarded)."""

    session: Session | None
    is_fragmented: bool = False
    work: Deferred[object] | None = None
    timer: IDelayedCall | None = None
    answer: bytes | None = None
    ended_at: float = 0.0


@dataclass(slots=True)
class _PeerRequests:
    """The requests of one peer.

    ``lowest_open`` maps each incarnation of the peer to the id below which it has no open request.
    """

    running: dict[int, RequestEntry] = field(default_factory=dict)
    finished: dict[int, RequestEntry] = field(default_factory=dict)
    lowest_open: dict[int, int] = field(default_factory=dict)
    last_received_at: float = 0.0


class RequestHistory:
    """The running requests, and those that ended in the last ``KEEP_ANSWER_S`` seconds, by public key and request id.

    Each request contains the id of the oldest request that its sender still waits for.  Older requests are forgotten
    immediately and are not executed if they arrive late.  A full history rejects new requests: if an old request were
    forgotten early, a method with side effects could run twice.
    """

    def __init__(self) -> None:
        self._peers: dict[bytes, _PeerRequests] = {}
        self._count = 0

    def __len__(self) -> int:
        return self._count

    def get(self, public: bytes, number: int) -> RequestEntry | None:
        """Return the entry of a request."""
        account = self._peers.get(public)
        return None if account is None else account.running.get(number) or account.finished.get(number)

    def is_settled(self, public: bytes, number: int) -> bool:
        """Return whether the requester no longer waits for this request."""
        account = self._peers.get(public)
        return account is not None and number < account.lowest_open.get(number >> SEQUENCE_BITS, 0)

    def forget_before(self, public: bytes, oldest: int, now: float) -> None:
        """Forget a peer's ended requests with ids below ``oldest``, because the peer no longer needs their answers."""
        account = self._get_or_create(public, now)
        if account is None:
            return  # ``begin`` will reject the request
        life = oldest >> SEQUENCE_BITS
        before = account.lowest_open.get(life)
        if before is None and len(account.lowest_open) >= MAX_INCARNATIONS:
            del account.lowest_open[next(iter(account.lowest_open))]
        if before is None or before < oldest:
            account.lowest_open[life] = oldest
            had = [number for number in account.finished if number < oldest and number >> SEQUENCE_BITS == life]
            for number in had:
                del account.finished[number]
            self._count -= len(had)

    def begin(
        self, public: bytes, number: int, session: Session | None, now: float, is_bulky: bool
    ) -> RequestEntry | None:
        """Add a request that is about to run; return None if the history is full."""
        account = self._get_or_create(public, now)
        if (
            account is None
            or self._count >= MAX_ENTRIES
            or len(account.running) + len(account.finished) >= MAX_PER_PEER
        ):
            return None
        entry = account.running[number] = RequestEntry(session, is_bulky)
        self._count += 1
        return entry

    def finish(self, public: bytes, number: int, answer: bytes | None, now: float) -> None:
        """Store the ``answer`` of a request that ran; None: forget the request, which may then run again."""
        account = self._peers.get(public)
        entry = account.running.pop(number, None) if account is not None else None
        if account is None or entry is None:
            return
        cancel(entry.timer)
        entry.work = None
        if answer is None or self.is_settled(public, number):
            self._count -= 1
        else:
            entry.answer, entry.ended_at, entry.session = answer, now, None
            account.finished[number] = entry

    def evict(self, public: bytes) -> list[Deferred[object]]:
        """Forget the requests of a peer; return the work that is still running, which the caller must cancel."""
        account = self._peers.pop(public, None)
        if account is None:
            return []
        self._count -= len(account.running) + len(account.finished)
        for entry in account.running.values():
            cancel(entry.timer)
        return [entry.work for entry in account.running.values() if entry.work is not None]

    def clear(self) -> None:
        """Forget all requests and cancel the timers."""
        for account in self._peers.values():
            for entry in account.running.values():
                cancel(entry.timer)
        self._peers.clear()
        self._count = 0

    def _make_room(self) -> bool:
        """Return whether the table has space for one more peer; if it is full, delete a peer that has no requests."""
        if len(self._peers) < MAX_REQUESTERS:
            return True
        idle = (public for public, account in self._peers.items() if not (account.running or account.finished))
        found = next(idle, None)
        if found is not None:
            del self._peers[found]
        return found is not None

    def _get_or_create(self, public: bytes, now: float) -> _PeerRequests | None:
        """Return the unexpired requests of a peer; None if the peer is new and the table is full.

        In a full table the least recently used peer is deleted if it has no requests and was unused for
        ``KEEP_ANSWER_S`` seconds.
        """
        account = self._peers.pop(public, None)
        if account is None:
            if not self._make_room():
                return None
            account = _PeerRequests()
        self._peers[public] = account  # the least recently used peer is first
        account.last_received_at = now
        self._expire(account, now)
        oldest_public, oldest = next(iter(self._peers.items()))
        if oldest.last_received_at <= now - KEEP_ANSWER_S:
            self._expire(oldest, now)
            if oldest.running or oldest.finished:
                self._peers[oldest_public] = self._peers.pop(oldest_public)
            else:
                del self._peers[oldest_public]
        return account

    def _expire(self, account: _PeerRequests, now: float) -> None:
        while account.finished:
            number, entry = next(iter(account.finished.items()))
            if entry.ended_at > now - KEEP_ANSWER_S:
                return
            del account.finished[number]
            self._count -= 1
