"""Method: what peers may call, with arguments checked before it runs; which calls ran; and how errors are named.

``Ledger`` keeps a repeated question from running twice.  ``ErrorCodes`` has the exceptions that cross the wire: a code
is looked up in a table that the program filled, and never imported.
"""

from __future__ import annotations

import contextlib
import inspect
import math
import types
import typing
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field

from twisted.internet.defer import CancelledError, Deferred
from twisted.internet.interfaces import IDelayedCall
from twisted.python.failure import Failure as Trouble

from middleware.entangled.errors import Refused
from middleware.entangled.kademlia.contact import Contact
from middleware.entangled.wire.message import BAD_ARGUMENTS, CANCELLED, Failure, is_code
from middleware.entangled.wire.peer import cancel
from middleware.entangled.wire.session import Session

KEPT_S = 30.0
MAX_PER_PEER = 1024
MAX_ENTRIES = 16384
_PLAIN = (int, float, bool, str, bytes, list, dict, type(None))


class BadArguments(Refused):
    """The number or the kinds of the arguments do not fit the method."""

    code = BAD_ARGUMENTS


@dataclass(frozen=True)
class Method:
    """An exposed function; ``changes`` says that it may run only in an established session, and once per question.

    A function with a keyword-only parameter ``deadline`` gets there the moment, on the clock of the node, after which
    nobody waits for its answer.
    """

    name: str
    answer: Callable[..., object]
    changes: bool = False
    _least: int = field(init=False, repr=False)
    _most: float = field(init=False, repr=False)
    _kinds: tuple[tuple[type, ...] | None, ...] = field(init=False, repr=False)
    _wants_deadline: bool = field(init=False, repr=False)

    def __post_init__(self) -> None:
        signature = inspect.signature(self.answer)
        try:
            hints = typing.get_type_hints(self.answer)
        except Exception:  # hints are foreign code too: names imported for type checkers only, partials, callables
            hints = {}
        positional = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
        parameters = [parameter for parameter in signature.parameters.values() if parameter.kind in positional]
        is_open = any(p.kind is inspect.Parameter.VAR_POSITIONAL for p in signature.parameters.values())
        required = sum(1 for parameter in parameters if parameter.default is inspect.Parameter.empty)
        # The first parameter is the peer.
        object.__setattr__(self, "_least", max(0, required - 1))
        object.__setattr__(self, "_most", math.inf if is_open else len(parameters) - 1)
        deadline = signature.parameters.get("deadline")
        wants_deadline = deadline is not None and deadline.kind is inspect.Parameter.KEYWORD_ONLY
        object.__setattr__(self, "_wants_deadline", wants_deadline)
        object.__setattr__(self, "_kinds", tuple(_kinds(hints.get(parameter.name)) for parameter in parameters[1:]))

    def run(self, peer: Contact, arguments: tuple[object, ...], deadline: float = math.inf) -> object:
        """Call the function; raises ``BadArguments`` where they do not fit, or what the function raises."""
        if not self._least <= len(arguments) <= self._most:
            count = f"{self._least}" if self._least == self._most else f"{self._least} to {self._most}"
            raise BadArguments(f"{self.name}: takes {count} arguments, was given {len(arguments)}")
        for place, (kinds, argument) in enumerate(zip(self._kinds, arguments, strict=False), start=1):
            if kinds is not None and type(argument) not in kinds:
                wanted = " or ".join("None" if kind is type(None) else kind.__name__ for kind in kinds)
                raise BadArguments(f"{self.name}: argument {place} must be {wanted}, is {type(argument).__name__}")
        if self._wants_deadline:
            return self.answer(peer, *arguments, deadline=deadline)
        return self.answer(peer, *arguments)


def _kinds(hint: object) -> tuple[type, ...] | None:
    """The plain types that a hint admits, or None where it says more than plain types can."""
    origin = typing.get_origin(hint)
    if origin in (typing.Union, types.UnionType):
        kinds: list[type] = []
        for part in typing.get_args(hint):
            inner = _kinds(part)
            if inner is None:
                return None
            kinds += inner
        return tuple(kinds)
    plain = origin or hint
    if plain is float:
        return (float, int)
    return (plain,) if plain in _PLAIN else None


class ErrorCodes:
    """The exceptions that cross the wire as themselves, and their codes."""

    def __init__(self) -> None:
        self._codes: dict[type[Exception], str] = {}
        self._kinds: dict[str, type[Exception]] = {}
        self.add(BadArguments, BAD_ARGUMENTS)

    def add(self, kind: type[Exception], code: str) -> None:
        """Name a class; raises ``ValueError`` where the code is taken, or is not 1 to 64 printable ASCII characters."""
        if not is_code(code):
            raise ValueError(f"{code!r} is no code; it has 1 to 64 printable ASCII characters")
        if self._kinds.get(code, kind) is not kind:
            raise ValueError(f"the code {code!r} belongs to {self._kinds[code].__name__}; choose another one")
        self._codes[kind] = code
        self._kinds[code] = kind

    def failure(self, number: int, trouble: Trouble) -> Failure | None:
        """What the asker of question ``number`` is told of an error; None where it is not meant for others."""
        error = trouble.value
        for kind in type(error).__mro__:
            if kind in self._codes:
                return Failure(number, self._codes[kind], str(error))
        if isinstance(error, Refused):
            return Failure(number, error.code if is_code(error.code) else Refused.code, str(error))
        if isinstance(error, CancelledError):
            return Failure(number, CANCELLED, "the call was cancelled")
        return None

    def error(self, failure: Failure) -> Exception:
        """The exception that a failure stands for: of its class where the code is known, else ``Refused`` with it."""
        kind = self._kinds.get(failure.code)
        if kind is not None:
            with contextlib.suppress(Exception):  # the class is the owner's code: it may want other arguments
                return kind(failure.text)
        return Refused(failure.text, failure.code)


@dataclass(slots=True)
class Entry:
    """One question; ``answer`` is None while it runs, ``session`` is where the answer goes (None: nowhere yet)."""

    session: Session | None
    is_bulky: bool = False
    work: Deferred[object] | None = None
    timer: IDelayedCall | None = None
    answer: bytes | None = None
    ended_at: float = 0.0


class Ledger:
    """The questions that run, and those that ended in the last ``KEPT_S`` seconds, by (public key, question id).

    When it is full new questions are turned away: forgetting an old one early could run a change twice.
    """

    def __init__(self) -> None:
        self._running: dict[tuple[bytes, int], Entry] = {}
        self._ended: dict[tuple[bytes, int], Entry] = {}
        self._per_peer: Counter[bytes] = Counter()

    def __len__(self) -> int:
        return len(self._running) + len(self._ended)

    def entry(self, public: bytes, question: int) -> Entry | None:
        """What is known of a question."""
        key = (public, question)
        return self._running.get(key) or self._ended.get(key)

    def begin(self, public: bytes, question: int, session: Session | None, now: float, is_bulky: bool) -> Entry | None:
        """Enter a question that is about to run; None where there is no room."""
        self._expire(now)
        if len(self) >= MAX_ENTRIES or self._per_peer[public] >= MAX_PER_PEER:
            return None
        entry = self._running[public, question] = Entry(session, is_bulky)
        self._per_peer[public] += 1
        return entry

    def end(self, public: bytes, question: int, answer: bytes | None, now: float) -> None:
        """Keep the ``answer`` of a question that ran, or forget the question where it is None and may run again."""
        entry = self._running.pop((public, question), None)
        if entry is None:
            return
        cancel(entry.timer)
        entry.work = None
        if answer is None:
            self._count_down(public)
        else:
            entry.answer, entry.ended_at, entry.session = answer, now, None
            self._ended[public, question] = entry

    def clear(self) -> None:
        """Forget everything, and cancel the timers."""
        for entry in self._running.values():
            cancel(entry.timer)
        self._running.clear()
        self._ended.clear()
        self._per_peer.clear()

    def _expire(self, now: float) -> None:
        while self._ended:
            key = next(iter(self._ended))
            if self._ended[key].ended_at > now - KEPT_S:
                return
            del self._ended[key]
            self._count_down(key[0])

    def _count_down(self, public: bytes) -> None:
        self._per_peer[public] -= 1
        if not self._per_peer[public]:
            del self._per_peer[public]
