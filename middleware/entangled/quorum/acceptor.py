"""The acceptor: promises ballots, grants leases and accepts values; ``TABLE`` determines each vote.

A decision uses Lamport's single-decree Paxos: prepare, then accept permanently.  A lease uses PaxosLease: prepare, then
lease for ``ttl`` seconds, and renew by leasing again under the same ballot.  A change of the configuration is a
decision that ends all leases (Vertical Paxos).  The comments refer to invariants by the labels of
``docs/explanation/quorum.md``, such as L1.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum
from typing import Any, Generic, NamedTuple

from middleware.entangled.quorum.acceptor_log import Key, RegisterLog
from middleware.entangled.quorum.ballot import FIRST_CONFIGURATION, NO_BALLOT, Ballot, Ceiling, ProposerName
from middleware.entangled.quorum.register import Register, Reply, ReplyKind

NO_ROOM_REPLY = Reply(ReplyKind.QUIET, remaining=1.0)
"""The reply if the acceptor has no space for another register: ask again in a second."""


class State(Enum):
    """The state of a register at an acceptor."""

    UNKNOWN = "unknown"
    OPEN = "open"
    SEALED = "sealed"
    OVER = "over"


class Event(Enum):
    """The request of a proposer."""

    PREPARE = "prepare"
    LEASE = "lease"
    ACCEPT = "accept"
    RELEASE = "release"


class BallotRelation(Enum):
    """The relation of a ballot to a register at one time."""

    BEHIND = "behind"
    """The configuration of the ballot is newer than the acceptor's."""
    MOVED = "moved"
    """The configuration of the ballot has been replaced."""
    HELD = "held"
    """Another proposer's lease is valid."""
    LOWER = "lower"
    """A higher ballot or token exists, the ballot was released, or its numbers are implausibly high."""
    OVERTAKEN = "overtaken"
    """The ballot is the holder's, but the time after the lease is promised to another proposer."""
    OWN = "own"
    """The ballot is the holder's, and the lease is valid."""
    ENDING = "ending"
    """Another proposer's lease is about to expire, or was released, but the holder's device may still move."""
    RESERVED = "reserved"
    """Another proposer's reservation is valid."""
    FOREIGN = "foreign"
    """The ballot has no promise or lease to release at this acceptor."""
    FREE = "free"


class _Request(NamedTuple):
    event: Event
    ballot: Ballot
    now: float
    configuration: int = FIRST_CONFIGURATION
    token: int = 0
    ttl: float = 0.0
    gives_back: bool = False


_COLUMNS = (
    BallotRelation.HELD,
    BallotRelation.LOWER,
    BallotRelation.OVERTAKEN,
    BallotRelation.OWN,
    BallotRelation.ENDING,
    BallotRelation.RESERVED,
    BallotRelation.FREE,
)
_G, _H, _O = ReplyKind.GRANTED, ReplyKind.HELD, ReplyKind.OUTBID
_VOTES = {
    # L3: a prepare during a lease changes nothing.
    Event.PREPARE: (_H, _O, _O, _G, _G, _H, _G),
    # L1: no lease is granted before the previous holder's lease has ended and its device is at rest.  L4: a promise for
    # the time after a lease does not end it.  A ballot that a majority promised may arrive during another proposer's
    # reservation: it overrides the reservation.
    Event.LEASE: (_H, _O, _G, _G, _H, _G, _G),
    # C2: no value is accepted during a lease.
    Event.ACCEPT: (_H, _O, _O, _H, _H, _G, _G),
}
_RELEASES = {
    BallotRelation.FOREIGN: ReplyKind.UNPREPARED,
    BallotRelation.LOWER: _O,
    BallotRelation.HELD: _G,
    BallotRelation.FREE: _G,
}


def _make_rows() -> Iterator[tuple[tuple[State, Event, BallotRelation], tuple[ReplyKind, State]]]:
    for state in State:
        is_unknown, is_sealed = state is State.UNKNOWN, state is State.SEALED
        for stand, kind in _RELEASES.items():
            yield (state, Event.RELEASE, stand), (ReplyKind.UNPREPARED if is_unknown else kind, state)
        for event, kinds in _VOTES.items():
            stands = dict(zip(_COLUMNS, kinds, strict=True)) | {
                BallotRelation.BEHIND: ReplyKind.BEHIND,
                BallotRelation.MOVED: ReplyKind.MOVED,
            }
            for stand, kind in stands.items():
                answer, after = kind, state
                if is_unknown and event is not Event.PREPARE:
                    answer = ReplyKind.UNPREPARED  # R4: the acceptor may have forgotten a promise
                elif state is State.OVER and stand is not BallotRelation.BEHIND:
                    answer = ReplyKind.OVER  # C4: after the end nothing is granted
                elif is_sealed and event is Event.LEASE and kind not in (ReplyKind.BEHIND, ReplyKind.MOVED):
                    answer = ReplyKind.SEALED  # C1: a sealed configuration leases nothing
                elif is_sealed and event is Event.PREPARE and kind is ReplyKind.GRANTED:
                    answer = ReplyKind.SEALED  # A2: a promise reports the accepted value
                elif kind is ReplyKind.GRANTED and (is_unknown or event is Event.ACCEPT):
                    after = State.OPEN if is_unknown else State.SEALED
                yield (state, event, stand), (answer, after)


TABLE = dict(_make_rows())
"""Maps (state, event, ballot relation) to (reply kind, next state)."""


@dataclass(frozen=True)
class AcceptorSettings:
    """Parameters of one use of registers.

    During the last part of a lease, the fraction ``early_share`` of its duration, the time after the lease may be
    promised.  For ``completion_s`` seconds only the proposer of an accepted value may complete it.  With
    ``must_prepare`` an unknown register has to be prepared first.
    """

    early_share: float = 0.0
    completion_s: float = 0.0
    must_prepare: bool = False


class Acceptor(Generic[Key]):
    """An acceptor that started at ``born_at``; if its log is incomplete, it grants nothing for the longest ttl."""

    def __init__(self, log: RegisterLog[Key], settings: AcceptorSettings, born_at: float = -math.inf) -> None:
        self.log = log
        self._settings = settings
        self._started_at = born_at

    def prepare(
        self, key: Key, configuration: int, ballot: Ballot, ttl: float, now: float, reserve: float = 0.0
    ) -> Reply:
        """Promise to accept nothing under a lower ballot, and reserve the promise for ``reserve`` seconds.

        ``ttl`` is the duration in seconds of the lease that the proposer will request.  A ballot with counter 0 only
        reads, without a promise.  If reads were promises, an acceptor that missed a renewal could promise to a reader,
        and the holder would lose its vote.
        """
        register, reply = self._decide(key, _Request(Event.PREPARE, ballot, now, configuration, ttl=ttl))
        if reply.kind in (ReplyKind.GRANTED, ReplyKind.SEALED):
            register.touched_at = now
            if ballot.counter > 0:
                is_new = ballot > register.promised or reserve != register.reserve
                register.promised = ballot  # P1: a promised ballot never decreases
                register.reserve, register.reserved_until = reserve, now + reserve
                if is_new:  # D1: durable before the reply
                    self.log.write(key)
            reply = self._reply(reply.kind, register, now)
        return reply._replace(remaining=0.0) if ballot.is_same_life(register.holder, self.log.codec.lives) else reply

    def lease(self, key: Key, configuration: int, ballot: Ballot, token: int, ttl: float, now: float) -> Reply:
        """Grant or renew the lease for ``ttl`` seconds from now."""
        register, reply = self._decide(key, _Request(Event.LEASE, ballot, now, configuration, token, ttl))
        if reply.kind is not ReplyKind.GRANTED:
            return reply
        promised = max(register.promised, ballot)
        before = register.promised, register.holder, register.token, register.ttl
        register.promised, register.holder, register.token, register.ttl = promised, ballot, token, ttl
        register.grantee = ballot.proposer
        register.lease_until, register.touched_at = now + ttl, now
        if before != (promised, ballot, token, ttl):  # D1: durable before the reply
            self.log.write(key)
        return self._reply(ReplyKind.GRANTED, register, now)

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
        """Accept ``value`` permanently.

        ``gives_back`` means that the proposer holds the lease, its device is at rest, and it gives up the lease with
        this request.  ``token`` is the highest token that the proposer knows.
        """
        register, reply = self._decide(key, _Request(Event.ACCEPT, ballot, now, configuration, token, 0.0, gives_back))
        if reply.kind is not ReplyKind.GRANTED:
            return reply
        is_new = (register.accepted, register.value) != (ballot, value)
        register.promised = register.accepted = ballot
        register.value, register.touched_at = value, now
        register.reserve, register.reserved_until = self._settings.completion_s, now + self._settings.completion_s
        register.record_token(token)
        if is_new:  # D1: durable before the reply
            self.log.write(key)
        return self._reply(ReplyKind.GRANTED, register, now)

    def release(self, key: Key, ballot: Ballot, now: float, rest: float = 0.0) -> Reply:
        """Release promises and leases under ``ballot`` and older ballots of the same process; accepted values stay.

        ``rest`` is the time in seconds in which the holder's device may still move.  During this time the lease can be
        promised but not granted.
        """
        request = _Request(Event.RELEASE, ballot, now)
        register, reply = self._decide(key, request)
        if reply.kind is not ReplyKind.GRANTED:
            return reply
        if self._find_relation(register, request) is BallotRelation.HELD:
            # The promise was for the time after another proposer's lease; this lease stays valid.
            register.promised = max(register.promised, Ballot(ballot.counter + 1, self.log.codec.lowest_name))
        else:
            # B3: a delayed request under this ballot is rejected.
            register.released = ballot
        if register.promised <= ballot:
            register.reserve, register.reserved_until = 0.0, now
        if ballot.is_same_life(register.holder, self.log.codec.lives) and register.holder <= ballot:
            register.lease_until = min(register.lease_until, now + rest)
            register.holder = register.holder if register.lease_until > now else NO_BALLOT
        self.log.write(key)  # D1: durable before the reply
        return self._reply(ReplyKind.GRANTED, register, now)

    def close(self, key: Key, proposer: ProposerName, configuration: int, token: int, now: float) -> Reply:
        """Close the register, so that it grants nothing; ``remaining`` is the time in which a holder may still act.

        A proposer proves its right to close the register by the token that this acceptor granted to it; the proposer
        may already have released the lease.  Callers without a lease pass token 0.  If the reply indicates that the
        configuration has changed, or may have changed, the caller must also close the next configuration.
        """
        register = self._get_or_enter(key, now)
        if register is None:
            return NO_ROOM_REPLY
        if token and (register.token, register.grantee) != (token, proposer):  # C5: this acceptor granted the token
            return self._reply(ReplyKind.OUTBID if token < register.token else ReplyKind.BEHIND, register, now)
        if not register.is_closed:
            register.is_closed, register.touched_at = True, now
            self.log.write(key)  # D1: durable before the reply
        has_moved, is_sealed = configuration < register.configuration, register.accepted != NO_BALLOT
        reply = self._reply(
            ReplyKind.MOVED if has_moved else ReplyKind.SEALED if is_sealed else ReplyKind.OVER, register, now
        )
        is_done = register.holder.proposer == proposer and register.token == token
        return reply._replace(remaining=0.0) if is_done else reply

    def install(
        self,
        key: Key,
        configuration: int,
        value: Any,
        token: int,
        now: float,
        ballot: Ballot = NO_BALLOT,
        ttl: float = 0.0,
        proof: bytes = b"",
    ) -> Reply:
        """Store ``value``, which the previous configuration decided, and the token above which new tokens start.

        The caller has checked the certificate ``proof`` of the decision.  The lease is reserved for the proposer of
        ``ballot`` for ``ttl`` seconds.
        """
        register = self._get_or_enter(key, now)
        if register is None:
            return NO_ROOM_REPLY
        if configuration > register.configuration:  # C3: configuration numbers only increase
            register.configuration, register.value, register.accepted = configuration, value, NO_BALLOT
            register.holder, register.lease_until = ballot, now if ballot == NO_BALLOT else now + ttl
            register.touched_at, register.proof = now, proof
            register.record_token(token, ballot.proposer)
            register.ceiling = Ceiling(now, self.log.codec.lives, register.promised.counter, register.token)
            self.log.write(key)  # D1: durable before the reply
        return self._reply(
            ReplyKind.GRANTED if configuration == register.configuration else ReplyKind.MOVED, register, now
        )

    # -- inside -----------------------------------------------------------------------------------------------------

    def _decide(self, key: Key, request: _Request) -> tuple[Register, Reply]:
        """Return the register, and the reply by ``TABLE``; store a new register only if something is granted."""
        event, ballot, now, *_ = request
        known = self.log.get(key)
        register = known or self.log.make_register(now)
        quiet = self._quiet_until(request.ttl) - now
        if quiet > 0.0 and event is not Event.RELEASE:  # R1: this acceptor may have forgotten a grant
            return register, Reply(ReplyKind.QUIET, remaining=quiet)
        is_unknown = known is None and (self._settings.must_prepare or event is Event.RELEASE)
        state = State.UNKNOWN if is_unknown else find_state(register)
        kind, _ = TABLE[state, event, self._find_relation(register, request)]
        if known is None and kind is ReplyKind.GRANTED and ballot.counter > 0 and not self.log.add(key, register, now):
            return register, NO_ROOM_REPLY
        return register, self._reply(kind, register, now)

    def _find_relation(self, register: Register, request: _Request) -> BallotRelation:
        event, ballot, now, configuration, token, _, gives_back = request
        lives = self.log.codec.lives
        left = register.lease_until - now
        is_own = ballot.is_same_life(register.holder, lives)  # L2: after a restart a node is another holder than before
        is_held = left > 0.0 and not is_own and not register.is_released
        if event is Event.RELEASE:
            if not (is_own or ballot.is_same_life(register.promised, lives)):
                return BallotRelation.FOREIGN
            return (
                BallotRelation.LOWER
                if ballot <= register.released
                else BallotRelation.HELD
                if is_held
                else BallotRelation.FREE
            )
        if configuration != register.configuration:  # C3: only the current configuration
            return BallotRelation.BEHIND if configuration > register.configuration else BallotRelation.MOVED
        if is_held and (ballot.counter == 0 or left > self._settings.early_share * register.ttl):
            return BallotRelation.HELD
        if ballot.counter > 0:
            is_lower_token = token < register.token or (token == register.token and not is_own)
            if event is Event.LEASE and is_lower_token:  # T2: a token belongs to one holder
                return BallotRelation.LOWER
            if ballot <= register.released:  # B3: released ballots get nothing
                return BallotRelation.LOWER
            if not register.ceiling.admits(now, ballot.counter, token):  # N1: numbers have a ceiling
                return BallotRelation.LOWER
            if ballot < register.promised:  # P1: lower ballots get nothing
                extends = left > 0.0 and is_own and not register.is_released and token == register.token
                return BallotRelation.OVERTAKEN if extends else BallotRelation.LOWER
        if left > 0.0 and not (gives_back and is_own):
            return BallotRelation.OWN if is_own else BallotRelation.ENDING
        is_reserved = register.reserved_until > now and not ballot.is_same_life(register.promised, lives)
        return BallotRelation.RESERVED if is_reserved else BallotRelation.FREE

    def _quiet_until(self, ttl: float) -> float:
        """Return the seconds during which this acceptor still grants nothing."""
        return -math.inf if self.log.is_complete else self._started_at + max(ttl, self.log.floor.longest)

    def _get_or_enter(self, key: Key, now: float) -> Register | None:
        """Return the register, or a new one if it does not exist; None if there is no space for it."""
        register = self.log.get(key) or self.log.make_register(now)
        return register if key in self.log.registers or self.log.add(key, register, now) else None

    def _reply(self, kind: ReplyKind, register: Register, now: float) -> Reply:
        remaining = max(0.0, register.lease_until - now, register.reserved_until - now)
        proof = register.proof if kind is ReplyKind.MOVED else b""
        known = register.promised, register.token, remaining, register.configuration, register.accepted, register.value
        return Reply(kind, *known, proof)


def find_state(register: Register) -> State:
    """Return the state of a register for the table."""
    if register.is_closed:
        return State.OVER
    return State.OPEN if register.accepted == NO_BALLOT else State.SEALED
