"""The acceptor: it promises, leases and accepts; every vote follows from ``TABLE``.

A decision is Lamport's single-decree Paxos: prepare, then accept for ever.  A lease is PaxosLease: prepare, then
lease for ``ttl`` seconds, extended by leasing again under the same ballot.  A change of the configuration is a
decision that ends all leases (Vertical Paxos).  ``docs/explanation/quorum.md`` has the invariants that are named here.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum
from typing import Any, Generic, NamedTuple

from middleware.entangled.quorum.ballot import FIRST, NONE, Ballot, Ceiling, Name
from middleware.entangled.quorum.log import Key, Log
from middleware.entangled.quorum.register import Kind, Register, Reply

NO_ROOM = Reply(Kind.QUIET, remaining=1.0)
"""The answer where there is no room for a register: ask again in a second."""


class State(Enum):
    """What an acceptor knows of a register."""

    UNKNOWN = "unknown"
    OPEN = "open"
    SEALED = "sealed"
    OVER = "over"


class Event(Enum):
    """What a proposer asks."""

    PREPARE = "prepare"
    LEASE = "lease"
    ACCEPT = "accept"
    RELEASE = "release"


class Stand(Enum):
    """How a ballot stands to a register at one moment."""

    BEHIND = "behind"
    """Its configuration is newer than the one that is known here."""
    MOVED = "moved"
    """Its configuration is over."""
    HELD = "held"
    """The lease of another runs."""
    LOWER = "lower"
    """It was outbid or given back, or its numbers are not believed."""
    OVERTAKEN = "overtaken"
    """It is the holder's; what follows its lease is promised to another."""
    OWN = "own"
    """It is the holder's, and the lease runs."""
    ENDING = "ending"
    """The lease of another is about to end, or was given back by a holder whose device still moves."""
    RESERVED = "reserved"
    """The leased promise of another runs."""
    FOREIGN = "foreign"
    """It has nothing to give back here."""
    FREE = "free"


class _Question(NamedTuple):
    event: Event
    ballot: Ballot
    now: float
    configuration: int = FIRST
    token: int = 0
    ttl: float = 0.0
    gives_back: bool = False


_COLUMNS = (Stand.HELD, Stand.LOWER, Stand.OVERTAKEN, Stand.OWN, Stand.ENDING, Stand.RESERVED, Stand.FREE)
_G, _H, _O = Kind.GRANTED, Kind.HELD, Kind.OUTBID
_VOTES = {
    # L3: to prepare while a lease runs changes nothing.
    Event.PREPARE: (_H, _O, _O, _G, _G, _H, _G),
    # L1: nothing is leased before the lease of another has ended and its device rests.
    # L4: a promise for the time after a lease does not end it.
    # A majority elsewhere has promised a ballot that comes under a reservation: the reservation has lost.
    Event.LEASE: (_H, _O, _G, _G, _H, _G, _G),
    # C2: no value is accepted while a lease runs.
    Event.ACCEPT: (_H, _O, _O, _H, _H, _G, _G),
}
_RELEASES = {Stand.FOREIGN: Kind.UNPREPARED, Stand.LOWER: _O, Stand.HELD: _G, Stand.FREE: _G}


def _rows() -> Iterator[tuple[tuple[State, Event, Stand], tuple[Kind, State]]]:
    for state in State:
        is_unknown, is_sealed = state is State.UNKNOWN, state is State.SEALED
        for stand, kind in _RELEASES.items():
            yield (state, Event.RELEASE, stand), (Kind.UNPREPARED if is_unknown else kind, state)
        for event, kinds in _VOTES.items():
            stands = dict(zip(_COLUMNS, kinds, strict=True)) | {Stand.BEHIND: Kind.BEHIND, Stand.MOVED: Kind.MOVED}
            for stand, kind in stands.items():
                answer, after = kind, state
                if is_unknown and event is not Event.PREPARE:
                    answer = Kind.UNPREPARED  # R4: what was promised here may be forgotten
                elif state is State.OVER and stand is not Stand.BEHIND:
                    answer = Kind.OVER  # C4: after the end nothing is granted
                elif is_sealed and event is Event.LEASE and kind not in (Kind.BEHIND, Kind.MOVED):
                    answer = Kind.SEALED  # C1: a sealed configuration leases nothing
                elif is_sealed and event is Event.PREPARE and kind is Kind.GRANTED:
                    answer = Kind.SEALED  # A2: a promise tells what was accepted
                elif kind is Kind.GRANTED and (is_unknown or event is Event.ACCEPT):
                    after = State.OPEN if is_unknown else State.SEALED
                yield (state, event, stand), (answer, after)


TABLE = dict(_rows())
"""(state, event, stand) to (answer, next state)."""


@dataclass(frozen=True)
class Terms:
    """How one use of registers differs from another.

    In the last ``ahead`` share of a lease what follows it is promised.  An accepted value is left to its proposer for
    ``finish`` seconds before another may complete it.  With ``must_prepare`` an unknown register has to be prepared.
    """

    ahead: float = 0.0
    finish: float = 0.0
    must_prepare: bool = False


class Acceptor(Generic[Key]):
    """A member since ``born_at``; about what its log may have forgotten it keeps silent for the longest ttl."""

    def __init__(self, log: Log[Key], terms: Terms, born_at: float = -math.inf) -> None:
        self.log = log
        self._terms = terms
        self._born_at = born_at

    def prepare(
        self, key: Key, configuration: int, ballot: Ballot, ttl: float, now: float, reserve: float = 0.0
    ) -> Reply:
        """Promise to accept nothing under a lower ballot, and lease the promise for ``reserve`` seconds.

        ``ttl`` is that of the lease which is to follow.  A ballot of counter 0 only looks and is promised nothing: an
        acceptor whose lease has run out, because it missed an extension, is not to be lost to the healthy holder.
        """
        register, reply = self._judge(key, _Question(Event.PREPARE, ballot, now, configuration, ttl=ttl))
        if reply.kind in (Kind.GRANTED, Kind.SEALED):
            register.touched_at = now
            if ballot.counter > 0:
                is_new = ballot > register.promised or reserve != register.reserve
                register.promised = ballot  # P1
                register.reserve, register.reserved_until = reserve, now + reserve
                if is_new:  # D1: what is answered is noted before
                    self.log.keep(key)
            reply = self._reply(reply.kind, register, now)
        return reply._replace(remaining=0.0) if ballot.is_kin(register.holder, self.log.codec.lives) else reply

    def lease(self, key: Key, configuration: int, ballot: Ballot, token: int, ttl: float, now: float) -> Reply:
        """Grant the lease for ``ttl`` seconds from now, or extend it."""
        register, reply = self._judge(key, _Question(Event.LEASE, ballot, now, configuration, token, ttl))
        if reply.kind is not Kind.GRANTED:
            return reply
        promised = max(register.promised, ballot)
        before = register.promised, register.holder, register.token, register.ttl
        register.promised, register.holder, register.token, register.ttl = promised, ballot, token, ttl
        register.grantee = ballot.proposer
        register.until, register.touched_at = now + ttl, now
        if before != (promised, ballot, token, ttl):  # D1: what is answered is noted before
            self.log.keep(key)
        return self._reply(Kind.GRANTED, register, now)

    def accept(
        self,
        key: Key,
        configuration: int,
        ballot: Ballot,
        value: Any,
        now: float,
        token: int = 0,
        gives_back: bool = False,
    ) -> Reply:
        """Accept ``value`` for ever.

        With ``gives_back`` a holder says that its own lease is given back (its device is at rest), and kept for it so
        long.  ``token`` is the highest that the proposer knows.
        """
        register, reply = self._judge(key, _Question(Event.ACCEPT, ballot, now, configuration, token, 0.0, gives_back))
        if reply.kind is not Kind.GRANTED:
            return reply
        is_new = (register.accepted, register.value) != (ballot, value)
        register.promised = register.accepted = ballot
        register.value, register.touched_at = value, now
        register.reserve, register.reserved_until = self._terms.finish, now + self._terms.finish
        register.hear_token(token)
        if is_new:  # D1
            self.log.keep(key)
        return self._reply(Kind.GRANTED, register, now)

    def release(self, key: Key, ballot: Ballot, now: float, rest: float = 0.0) -> Reply:
        """End what was promised or leased under ``ballot``, or an older one of its life; what was accepted stays.

        ``rest`` is how long the holder's device may still move: until then the lease is promised, but not granted.
        """
        question = _Question(Event.RELEASE, ballot, now)
        register, reply = self._judge(key, question)
        if reply.kind is not Kind.GRANTED:
            return reply
        if self._stand(register, question) is Stand.HELD:
            # It was promised for the time after another's lease, which goes on.
            register.promised = max(register.promised, Ballot(ballot.counter + 1, self.log.codec.nobody))
        else:
            # B3: a request of that ballot may still be on its way: it comes too late.
            register.spent = ballot
        if register.promised <= ballot:
            register.reserve, register.reserved_until = 0.0, now
        if ballot.is_kin(register.holder, self.log.codec.lives) and register.holder <= ballot:
            register.until = min(register.until, now + rest)
            register.holder = register.holder if register.until > now else NONE
        self.log.keep(key)  # D1
        return self._reply(Kind.GRANTED, register, now)

    def close(self, key: Key, proposer: Name, configuration: int, token: int, now: float) -> Reply:
        """Grant nothing any more; ``remaining`` is how long another may still act.

        A proposer names the token that it was granted here, even if it has given the lease back since.  Token 0 is the
        word of a caller that needs no lease.  Where the configuration has changed, or may have, the next one has to be
        asked as well.
        """
        register = self._known(key, now)
        if register is None:
            return NO_ROOM
        if token and (register.token, register.grantee) != (token, proposer):  # C5: a proof names the granted token
            return self._reply(Kind.OUTBID if token < register.token else Kind.BEHIND, register, now)
        if not register.is_over:
            register.is_over, register.touched_at = True, now
            self.log.keep(key)  # D1
        has_moved, is_sealed = configuration < register.configuration, register.accepted != NONE
        reply = self._reply(Kind.MOVED if has_moved else Kind.SEALED if is_sealed else Kind.OVER, register, now)
        is_done = register.holder.proposer == proposer and register.token == token
        return reply._replace(remaining=0.0) if is_done else reply

    def install(
        self,
        key: Key,
        configuration: int,
        value: Any,
        token: int,
        now: float,
        ballot: Ballot = NONE,
        ttl: float = 0.0,
        proof: bytes = b"",
    ) -> Reply:
        """Learn that the configuration before has decided on ``value``, and above which token that goes on.

        The caller has checked the certificate ``proof``.  For ``ttl`` seconds the lease is kept for the proposer of
        ``ballot``.
        """
        register = self._known(key, now)
        if register is None:
            return NO_ROOM
        if configuration > register.configuration:  # C3: configurations only rise
            register.configuration, register.value, register.accepted = configuration, value, NONE
            register.holder, register.until = ballot, now if ballot == NONE else now + ttl
            register.touched_at, register.proof = now, proof
            register.hear_token(token, ballot.proposer)
            register.ceiling = Ceiling(now, self.log.codec.lives, register.promised.counter, register.token)
            self.log.keep(key)  # D1
        return self._reply(Kind.GRANTED if configuration == register.configuration else Kind.MOVED, register, now)

    # -- inside -----------------------------------------------------------------------------------------------------

    def _judge(self, key: Key, question: _Question) -> tuple[Register, Reply]:
        """The register and the answer of the table; a register that nothing is granted in takes no room."""
        event, ballot, now, *_ = question
        known = self.log.get(key)
        register = known or self.log.blank(now)
        quiet = self._silence(question.ttl) - now
        if quiet > 0.0 and event is not Event.RELEASE:  # R1: it may have granted what it has forgotten
            return register, Reply(Kind.QUIET, remaining=quiet)
        is_unknown = known is None and (self._terms.must_prepare or event is Event.RELEASE)
        state = State.UNKNOWN if is_unknown else state_of(register)
        kind, _ = TABLE[state, event, self._stand(register, question)]
        if known is None and kind is Kind.GRANTED and ballot.counter > 0 and not self.log.enter(key, register, now):
            return register, NO_ROOM
        return register, self._reply(kind, register, now)

    def _stand(self, register: Register, question: _Question) -> Stand:
        event, ballot, now, configuration, token, _, gives_back = question
        lives = self.log.codec.lives
        left = register.until - now
        is_own = ballot.is_kin(register.holder, lives)  # L2: an earlier life of the holder is another holder
        is_held = left > 0.0 and not is_own and not register.is_given_back
        if event is Event.RELEASE:
            if not (is_own or ballot.is_kin(register.promised, lives)):
                return Stand.FOREIGN
            return Stand.LOWER if ballot <= register.spent else Stand.HELD if is_held else Stand.FREE
        if configuration != register.configuration:  # C3
            return Stand.BEHIND if configuration > register.configuration else Stand.MOVED
        if is_held and (ballot.counter == 0 or left > self._terms.ahead * register.ttl):
            return Stand.HELD
        if ballot.counter > 0:
            is_lower_token = token < register.token or (token == register.token and not is_own)
            if event is Event.LEASE and is_lower_token:  # T2: a token belongs to one holder
                return Stand.LOWER
            if ballot <= register.spent:  # B3
                return Stand.LOWER
            if not register.ceiling.admits(now, ballot.counter, token):  # N1
                return Stand.LOWER
            if ballot < register.promised:  # P1
                extends = left > 0.0 and is_own and not register.is_given_back and token == register.token
                return Stand.OVERTAKEN if extends else Stand.LOWER
        if left > 0.0 and not (gives_back and is_own):
            return Stand.OWN if is_own else Stand.ENDING
        is_reserved = register.reserved_until > now and not ballot.is_kin(register.promised, lives)
        return Stand.RESERVED if is_reserved else Stand.FREE

    def _silence(self, ttl: float) -> float:
        """Until when nothing is granted."""
        return -math.inf if self.log.is_whole else self._born_at + max(ttl, self.log.floor.longest)

    def _known(self, key: Key, now: float) -> Register | None:
        """A register to learn something about, or None where there is no room."""
        register = self.log.get(key) or self.log.blank(now)
        return register if key in self.log.registers or self.log.enter(key, register, now) else None

    def _reply(self, kind: Kind, register: Register, now: float) -> Reply:
        remaining = max(0.0, register.until - now, register.reserved_until - now)
        proof = register.proof if kind is Kind.MOVED else b""
        known = register.promised, register.token, remaining, register.configuration, register.accepted, register.value
        return Reply(kind, *known, proof)


def state_of(register: Register) -> State:
    """Where a register stands in the table."""
    if register.is_over:
        return State.OVER
    return State.OPEN if register.accepted == NONE else State.SEALED
