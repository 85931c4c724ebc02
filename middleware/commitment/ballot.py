"""Ballot: the numbers under which claimants speak, and what a member of a council answers to them; pure.

Durations travel, never moments (PaxosLease, arXiv 1209.4187).
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

from middleware.entangled.errors import Refused
from middleware.entangled.kademlia.contact import Contact, unpacked

MAX_NUMBER = 2**62
"""Below it lie all counters, tokens and configurations."""
MAX_COUNCIL = 7
FIRST = 1
"""The configuration of the council that the task was made with."""
ROOM = 2**32
RATE = 2**10
"""A member refuses tokens and attempts above ``ROOM``, or what it knew when it began to count, and ``RATE`` more a
second.  So nobody can use them up: there are 2**42 attempts, enough for 136 years, and more tokens."""
TOLD_BY_ONE = ROOM // 2
"""A claimant believes a higher number only where two members tell it: one alone may have invented it."""

GRANTED = "granted"
HELD = "held"
"""Another's lease has not run out; ``remaining`` says when it will."""
OUTBID = "outbid"
"""A higher ballot was promised, or a higher token granted."""
QUIET = "quiet"
"""The member may have forgotten what it granted; ``remaining`` says for how long it grants nothing."""
BEHIND = "behind"
"""The member has not been told of that configuration of the council."""
SEALED = "sealed"
"""The promise is given, but a change of the council was accepted before: no lease, only that change may follow."""
MOVED = "moved"
"""That configuration is over; ``configuration`` and ``members`` tell the present one."""
OVER = "over"
"""The task has ended."""
KINDS = (GRANTED, HELD, OUTBID, QUIET, BEHIND, SEALED, MOVED, OVER)


LIFE = 2**20
"""The lowest digits of a counter are dice, thrown anew in each life of an agent."""


class Ballot(NamedTuple):
    """The number of one attempt; the agent's id makes it unique and breaks ties."""

    counter: int
    agent: str

    def is_kin(self, other: Ballot) -> bool:
        """Whether both are of the same life of an agent: a former life's robot may still move, as far as this knows."""
        return self.agent == other.agent and self.counter % LIFE == other.counter % LIFE


NONE = Ballot(0, "")


class Reply(NamedTuple):
    """What a member answers; ``token`` is the highest that it has granted, ``remaining`` counts from its answer on.

    ``ballot`` is the highest promised, or of ``SEALED`` the one under which the change was accepted.  ``proof`` is the
    charter of the council that ``MOVED`` names, or the signature of who accepted a change or the end of the task.
    """

    kind: str
    ballot: Ballot = NONE
    token: int = 0
    remaining: float = 0.0
    configuration: int = 0
    members: tuple[Contact, ...] = ()
    proof: bytes = b""

    def packed(self) -> list[object]:
        """The reply as it stands in a message; most have no proof."""
        members = [member.packed() for member in self.members]
        proof = [self.proof] if self.proof else []
        return [self.kind, *self.ballot, self.token, self.remaining, self.configuration, members, *proof]


def reply_of(answer: object) -> Reply | None:
    """The reply that ``packed`` made, or None where the answer cannot be one; never raises."""
    if not isinstance(answer, list) or not 7 <= len(answer) <= 8:
        return None
    kind, counter, agent, token, remaining, configuration, packed = answer[:7]
    proof = answer[7] if len(answer) > 7 else b""
    members = members_of(packed)
    lawful = (
        isinstance(kind, str)
        and kind in KINDS
        and all(map(is_number, (counter, token, configuration)))
        and isinstance(agent, str)
        and isinstance(remaining, float)
        and isinstance(proof, bytes)
        and members is not None
    )
    if not lawful or members is None:
        return None
    # What cannot be a duration counts as none.
    remaining = remaining if remaining > 0.0 else 0.0
    return Reply(kind, Ballot(counter, agent), token, remaining, configuration, members, proof)


def members_of(packed: object) -> tuple[Contact, ...] | None:
    """The members of a council as they stand in a message, or None where these cannot be some."""
    if not isinstance(packed, list) or len(packed) > MAX_COUNCIL:
        return None
    members = tuple(contact for fields in packed if (contact := unpacked(fields)) is not None)
    return members if len(members) == len(packed) == len({member.public for member in members}) else None


class Ceiling:
    """The highest token and the highest attempt (``counter // LIFE``) that are believed, counted from ``since`` on."""

    __slots__ = ("_attempts", "_since", "_tokens")

    def __init__(self, since: float, ballot: Ballot = NONE, token: int = 0) -> None:
        self._since = since
        self._attempts = max(ROOM, ballot.counter // LIFE)
        self._tokens = max(ROOM, token)

    def admits(self, now: float, counter: int, token: int = 0) -> bool:
        """Whether both numbers are low enough to be believed at ``now``."""
        rise = int(RATE * max(0.0, now - self._since))
        return counter // LIFE <= self._attempts + rise and token <= self._tokens + rise


def is_number(value: object) -> bool:
    """Whether ``value`` can be a counter, token or configuration."""
    return type(value) is int and 0 <= value < MAX_NUMBER


AHEAD = 0.2
"""Share of a ttl before the end of a lease from which on its successor is promised."""


def believed(numbers: Iterable[int], size: int) -> int:
    """The highest of the ``numbers`` that members of a council of ``size`` told, and that not one alone invented."""
    told = sorted(numbers, reverse=True)
    witnessed = told[1:] if size > 2 else told
    return max([*witnessed[:1], *(number for number in told if number <= TOLD_BY_ONE)], default=0)


def quorum(size: int) -> int:
    """How many of ``size`` members are a majority."""
    return size // 2 + 1


class OpenClaim(Refused):
    """The council cannot change: somebody holds a lease of it."""


class Superseded(Refused):
    """Another council was chosen than the one that was asked for; the present one is known now."""


class NoMajority(Refused):
    """Too few members of the council answered, or another claimant was faster; try again."""
