"""Decree: one question that a council decides once, and for good (single-decree Paxos with a lease); pure.

The question is who takes a thing; the value is the taker's name.  A claimant first *claims* at a majority under a
ballot, then *confirms*; what a majority has accepted under one ballot is decided, and a later claimant can only
complete it.  The lease keeps others from outbidding a claimant that is alive; safety never rests on it, nor on a clock.
``Vote`` is what one council member remembers of one decree, ``Tally`` counts the answers for a claimant.

What a member answers follows from ``TABLE``: (state, event, how the ballot stands to the one promised) gives the
answer and the next state.  After L. Lamport, *Paxos Made Simple* (2001); the lease after PaxosLease (arXiv 1209.4187).
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from enum import Enum, IntEnum
from typing import NamedTuple

MAX_COUNTER = 2**48
MAX_LEASE = 600.0
ACCEPTED_LEASE = 1.0
"""Seconds that a member gives a claimant to finish what it has begun to confirm, before another may complete it."""
MAX_NAME_BYTES = 40


class Ballot(NamedTuple):
    """A claimant's bid; ballots are totally ordered, and no two claimants ever use the same one."""

    counter: int
    taker: bytes


class State(Enum):
    """What a member has said about a decree."""

    FREE = "free"
    CLAIMED = "claimed"
    CONFIRMED = "confirmed"


class Event(Enum):
    """What a claimant asks."""

    CLAIM = "claim"
    CONFIRM = "confirm"
    RELEASE = "release"


class Stand(Enum):
    """How a ballot stands to the one that was promised; ``EARLY`` is higher, while another's lease runs."""

    LOWER = "lower"
    SAME = "same"
    EARLY = "early"
    HIGHER = "higher"


class Kind(IntEnum):
    """What a member answers."""

    PROMISED = 0
    ACCEPTED = 1
    LEASED = 2
    OUTBID = 3
    UNCLAIMED = 4
    RELEASED = 5


_ROWS: dict[tuple[State, Event, Stand], tuple[Kind, State]] = {
    (State.FREE, Event.CLAIM, Stand.HIGHER): (Kind.PROMISED, State.CLAIMED),
    # Whoever was never promised anything here may have been forgotten here: it has to claim first.
    (State.FREE, Event.CONFIRM, Stand.HIGHER): (Kind.UNCLAIMED, State.FREE),
    (State.FREE, Event.RELEASE, Stand.HIGHER): (Kind.UNCLAIMED, State.FREE),
}
for _state in (State.CLAIMED, State.CONFIRMED):
    _ROWS |= {
        (_state, Event.CLAIM, Stand.LOWER): (Kind.OUTBID, _state),
        (_state, Event.CLAIM, Stand.SAME): (Kind.PROMISED, _state),
        (_state, Event.CLAIM, Stand.EARLY): (Kind.LEASED, _state),
        (_state, Event.CLAIM, Stand.HIGHER): (Kind.PROMISED, _state),
        (_state, Event.CONFIRM, Stand.LOWER): (Kind.OUTBID, _state),
        (_state, Event.CONFIRM, Stand.SAME): (Kind.ACCEPTED, State.CONFIRMED),
        # A majority elsewhere has promised this ballot, so the lease that runs here has lost already.
        (_state, Event.CONFIRM, Stand.EARLY): (Kind.ACCEPTED, State.CONFIRMED),
        (_state, Event.CONFIRM, Stand.HIGHER): (Kind.ACCEPTED, State.CONFIRMED),
        (_state, Event.RELEASE, Stand.LOWER): (Kind.OUTBID, _state),
        (_state, Event.RELEASE, Stand.SAME): (Kind.RELEASED, _state),
        (_state, Event.RELEASE, Stand.EARLY): (Kind.UNCLAIMED, _state),
        (_state, Event.RELEASE, Stand.HIGHER): (Kind.UNCLAIMED, _state),
    }
TABLE = dict(_ROWS)
"""(state, event, stand) to (answer, next state); a triple that is not here cannot occur."""


@dataclass(frozen=True)
class Reply:
    """A member's answer.

    ``counter`` is that of the highest ballot promised there, ``remaining`` the seconds until its lease runs out;
    ``accepted`` and ``value`` are what the member has accepted, if anything.
    """

    kind: Kind
    counter: int = 0
    remaining: float = 0.0
    accepted: Ballot | None = None
    value: bytes | None = None

    def packed(self) -> list[object]:
        """The reply as it stands in a message."""
        accepted = None if self.accepted is None else [self.accepted.counter, self.accepted.taker, self.value]
        return [int(self.kind), self.counter, self.remaining, accepted]


def reply_unpacked(fields: object) -> Reply | None:
    """The reply that ``Reply.packed`` made, or None where the fields cannot be one."""
    if not isinstance(fields, list) or len(fields) != 4:
        return None
    kind, counter, remaining, accepted = fields
    if not (type(kind) is int and 0 <= kind < len(Kind) and is_counter(counter, 0)):
        return None
    if type(remaining) is not float or not 0.0 <= remaining <= MAX_LEASE:
        return None
    if accepted is None:
        return Reply(Kind(kind), counter, remaining)
    if not isinstance(accepted, list) or len(accepted) != 3:
        return None
    bid, taker, value = accepted
    if not (is_counter(bid) and is_name(taker) and is_name(value)):
        return None
    return Reply(Kind(kind), counter, remaining, Ballot(bid, taker), value)


def is_counter(value: object, least: int = 1) -> bool:
    """Whether ``value`` may be the counter of a ballot."""
    return type(value) is int and least <= value < MAX_COUNTER


def is_name(value: object) -> bool:
    """Whether ``value`` may be the name of a taker."""
    return type(value) is bytes and 0 < len(value) <= MAX_NAME_BYTES


@dataclass
class Vote:
    """What one council member has promised and accepted about one decree.

    ``until`` is the end of the lease on the member's own clock.  A vote may be forgotten only when nobody can ask for
    its decree any more.
    """

    promised: Ballot | None = None
    lease: float = 0.0
    until: float = 0.0
    accepted: Ballot | None = None
    value: bytes | None = None

    @property
    def state(self) -> State:
        """Where this vote stands in the table."""
        if self.promised is None:
            return State.FREE
        return State.CLAIMED if self.accepted is None else State.CONFIRMED

    def claim(self, ballot: Ballot, lease: float, now: float) -> Reply:
        """Promise ``ballot`` and lease the decree to its taker for ``lease`` seconds, or say what stands against it.

        The same ballot once more renews the lease.
        """
        kind, _ = TABLE[self.state, Event.CLAIM, self._stand(ballot, now)]
        if kind is Kind.PROMISED:
            self.promised, self.lease, self.until = ballot, lease, now + lease
        return self._reply(kind, now)

    def confirm(self, ballot: Ballot, value: bytes, now: float) -> Reply:
        """Accept ``value`` under ``ballot`` unless a higher one was promised."""
        kind, _ = TABLE[self.state, Event.CONFIRM, self._stand(ballot, now)]
        if kind is Kind.ACCEPTED:
            self.promised, self.accepted, self.value = ballot, ballot, value
            self.lease, self.until = ACCEPTED_LEASE, now + ACCEPTED_LEASE
        return self._reply(kind, now)

    def release(self, ballot: Ballot, now: float) -> Reply:
        """End the lease of ``ballot`` early; what was accepted stays accepted."""
        kind, _ = TABLE[self.state, Event.RELEASE, self._stand(ballot, now)]
        if kind is Kind.RELEASED:
            self.until = min(self.until, now)
        return self._reply(kind, now)

    def _stand(self, ballot: Ballot, now: float) -> Stand:
        if self.promised is None:
            return Stand.HIGHER
        if ballot <= self.promised:
            return Stand.SAME if ballot == self.promised else Stand.LOWER
        return Stand.EARLY if ballot.taker != self.promised.taker and self.until > now else Stand.HIGHER

    def _reply(self, kind: Kind, now: float) -> Reply:
        counter = self.promised.counter if self.promised else 0
        return Reply(kind, counter, max(0.0, min(self.until - now, MAX_LEASE)), self.accepted, self.value)


class Result(Enum):
    """How a round at the council ended."""

    WON = "won"
    """A majority promised, or accepted, as it was asked."""
    DECIDED = "decided"
    """The decree is over: ``value`` is what was decided, by whomsoever."""
    LEASED = "leased"
    OUTBID = "outbid"
    SILENT = "silent"
    """Too few members answered."""


class Outcome(NamedTuple):
    """The end of a round.

    ``value``: of ``DECIDED`` what was decided; of a claim that is ``WON`` what must be confirmed instead of the own
    name, if anything.  ``counter``: the highest seen.  ``remaining``: seconds until the lease of another runs out.
    """

    result: Result
    value: bytes | None = None
    counter: int = 0
    remaining: float = 0.0


class Tally:
    """The answers of a council of ``size`` to one claim (or to one confirm, of ``value`` under ``ballot``)."""

    def __init__(self, size: int, wanted: Kind = Kind.PROMISED) -> None:
        self._size = size
        self._wanted = wanted
        self._replies: list[Reply] = []
        self._lost = 0

    def add(self, reply: Reply | None) -> None:
        """Count one member's answer; None for a member that cannot be heard."""
        if reply is None:
            self._lost += 1
        else:
            self._replies.append(reply)

    @property
    def outcome(self) -> Outcome | None:
        """How the round ended, or None while an answer can still turn it."""
        quorum = self._size // 2 + 1
        counter = max((reply.counter for reply in self._replies), default=0)
        accepted = Counter((r.accepted, r.value) for r in self._replies if r.accepted is not None)
        for (_, value), count in accepted.items():
            if count >= quorum:
                return Outcome(Result.DECIDED, value, counter)
        good = [reply for reply in self._replies if reply.kind is self._wanted]
        if len(good) >= quorum:
            highest = max((r for r in good if r.accepted is not None), key=_bid, default=None)
            return Outcome(Result.WON, highest.value if highest else None, counter)
        left = self._size - len(self._replies) - self._lost
        if len(good) + left >= quorum:
            return None
        kinds = [reply.kind for reply in self._replies]
        remaining = max((r.remaining for r in self._replies if r.kind is Kind.LEASED), default=0.0)
        if Kind.OUTBID in kinds:
            return Outcome(Result.OUTBID, None, counter, remaining)
        if Kind.LEASED in kinds:
            return Outcome(Result.LEASED, None, counter, remaining)
        return Outcome(Result.SILENT, None, counter)


def _bid(reply: Reply) -> Ballot:
    return reply.accepted or Ballot(0, b"")
