"""Ballots, and the numbers that are believed; pure."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, NamedTuple

MAX_NUMBER = 2**62
"""Below it lie all counters, tokens and configurations."""
FIRST = 1
"""The configuration with which a register begins."""
ROOM = 2**32
RATE = 2**10
"""An acceptor refuses tokens and attempts above ``ROOM``, or above its own when it began to count, plus ``RATE`` a
second.  So a proposer cannot use them up: there are 2**42 attempts, enough for 136 years, and more tokens."""
TOLD_BY_ONE = ROOM // 2
"""A proposer believes a higher number only where two acceptors tell it: a single one may have invented it."""

Name = Any
"""The name of a proposer: ``str`` or ``bytes``, the same in all ballots of a register."""


class Ballot(NamedTuple):
    """The number of one attempt; the name of its proposer makes it unique and breaks ties (invariant B1)."""

    counter: int
    proposer: Name

    def is_kin(self, other: Ballot, lives: int) -> bool:
        """Whether both are of the same life of a proposer; the lives differ in ``counter % lives``."""
        return self.proposer == other.proposer and self.counter % lives == other.counter % lives


NONE = Ballot(0, "")


class Ceiling:
    """The highest attempt (``counter // lives``) and token that an acceptor believes, counted from ``since`` on."""

    __slots__ = ("_attempts", "_lives", "_since", "_tokens")

    def __init__(self, since: float, lives: int, counter: int = 0, token: int = 0) -> None:
        self._since = since
        self._lives = lives
        self._attempts = max(ROOM, counter // lives)
        self._tokens = max(ROOM, token)

    def admits(self, now: float, counter: int, token: int = 0) -> bool:
        """Whether both numbers are low enough to be believed at ``now``."""
        rise = int(RATE * max(0.0, now - self._since))
        return counter // self._lives <= self._attempts + rise and token <= self._tokens + rise


def is_number(value: object) -> bool:
    """Whether ``value`` can be a counter, token or configuration."""
    return type(value) is int and 0 <= value < MAX_NUMBER


def believed(numbers: Iterable[int], size: int) -> int:
    """The highest of the ``numbers`` that a quorum of ``size`` members told and that not one alone invented."""
    told = sorted(numbers, reverse=True)
    witnessed = told[1:] if size > 2 else told
    return max([*witnessed[:1], *(number for number in told if number <= TOLD_BY_ONE)], default=0)


def majority(size: int) -> int:
    """How many of ``size`` members decide; two majorities share a member (invariant Q1)."""
    return size // 2 + 1
