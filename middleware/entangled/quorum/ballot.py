"""Ballots, and limits on the numbers that members accept from each other; without I/O."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, NamedTuple

MAX_NUMBER = 2**62
"""Counters, tokens and configurations are below this number."""
FIRST_CONFIGURATION = 1
"""The first configuration of a register."""
INITIAL_CEILING = 2**32
CEILING_RATE_PER_S = 2**10
"""The rate at which the ceilings of tokens and attempts at an acceptor rise.  An acceptor rejects tokens and attempts
above its ceiling.  The ceiling starts at ``INITIAL_CEILING``, or at the acceptor's own number at its start if that is
higher.  A proposer cannot exhaust the numbers: the 2**42 attempts last for 136 years, and there are more tokens."""
MAX_UNCONFIRMED = INITIAL_CEILING // 2
"""A proposer accepts a number above this limit only if two acceptors report it, because a single acceptor may have
invented it."""

ProposerName = Any
"""The name of a proposer is of type ``str`` or ``bytes``; all ballots of a register use the same type."""


class Ballot(NamedTuple):
    """The number of an attempt; the name of its proposer makes it unique and breaks ties (invariant B1)."""

    counter: int
    proposer: ProposerName

    def is_same_life(self, other: Ballot, lives: int) -> bool:
        """Return whether both ballots are from the same process of a proposer, identified by ``counter % lives``."""
        return self.proposer == other.proposer and self.counter % lives == other.counter % lives


NO_BALLOT = Ballot(0, "")


class Ceiling:
    """Upper bounds of attempts (``counter // lives``) and tokens at an acceptor, rising from the time ``since``."""

    __slots__ = ("_max_attempts", "_lives", "_since", "_max_tokens")

    def __init__(self, since: float, lives: int, counter: int = 0, token: int = 0) -> None:
        self._since = since
        self._lives = lives
        self._max_attempts = max(INITIAL_CEILING, counter // lives)
        self._max_tokens = max(INITIAL_CEILING, token)

    def admits(self, now: float, counter: int, token: int = 0) -> bool:
        """Return whether both numbers are within the bounds at ``now``."""
        rise = int(CEILING_RATE_PER_S * max(0.0, now - self._since))
        return counter // self._lives <= self._max_attempts + rise and token <= self._max_tokens + rise


def is_number(value: object) -> bool:
    """Return whether ``value`` can be a counter, token or configuration."""
    return type(value) is int and 0 <= value < MAX_NUMBER


def highest_credible(numbers: Iterable[int], size: int) -> int:
    """Return the highest credible one of the ``numbers`` that members of a quorum of ``size`` reported.

    A number is credible if no single member can have invented it.
    """
    descending = sorted(numbers, reverse=True)
    witnessed = descending[1:] if size > 2 else descending
    return max([*witnessed[:1], *(number for number in descending if number <= MAX_UNCONFIRMED)], default=0)


def majority(size: int) -> int:
    """Return the majority of ``size`` members; any two majorities share a member (invariant Q1)."""
    return size // 2 + 1
