"""What an acceptor knows of one register, and what it answers; plain data."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum
from typing import Any, NamedTuple

from middleware.entangled.quorum.ballot import FIRST, NONE, Ballot, Ceiling, Name


class Kind(Enum):
    """The answer of an acceptor."""

    GRANTED = "granted"
    HELD = "held"
    """The lease of another, or its leased promise, has not run out; ``remaining`` says when it will."""
    OUTBID = "outbid"
    """A higher ballot was promised, a higher token granted, or the ballot was given back."""
    UNPREPARED = "unprepared"
    """The register is unknown here, or the ballot has no part in it: prepare first."""
    QUIET = "quiet"
    """The acceptor may have forgotten what it granted, or has no room; ``remaining`` says when to ask again."""
    BEHIND = "behind"
    """The acceptor has not been told of that configuration."""
    SEALED = "sealed"
    """The ballot is promised, but a value was accepted before: only that value may follow."""
    MOVED = "moved"
    """That configuration is over; ``configuration`` and ``proof`` tell the present one."""
    OVER = "over"
    """The register is closed."""


class Reply(NamedTuple):
    """What an acceptor answers; ``remaining`` counts from the answer on.

    ``promised`` is the highest ballot promised, ``token`` the highest granted, ``accepted`` and ``value`` what was
    accepted.  ``proof`` is the certificate of the configuration that ``MOVED`` names, or a signature of the acceptor.
    """

    kind: Kind
    promised: Ballot = NONE
    token: int = 0
    remaining: float = 0.0
    configuration: int = 0
    accepted: Ballot = NONE
    value: Any = None
    proof: bytes = b""


@dataclass(slots=True)
class Register:
    """What an acceptor has promised, leased and accepted.

    ``promised`` is the highest ballot promised, leased for ``reserve`` seconds, ``reserved_until`` then.  ``holder`` is
    the ballot of the lease, granted for ``ttl`` seconds ``until`` then; ``spent`` the highest ballot given back.
    ``token`` is the fencing token, ``grantee`` the proposer to which it was granted here, empty where it was only heard
    of.  ``value`` was accepted for ever under ``accepted``; where that is none it is the present configuration, as far
    as known, and ``proof`` its certificate.  Moments are on the clock of one process and are not stored.
    """

    ceiling: Ceiling
    configuration: int = FIRST
    promised: Ballot = NONE
    holder: Ballot = NONE
    spent: Ballot = NONE
    accepted: Ballot = NONE
    token: int = 0
    grantee: Name = ""
    ttl: float = 0.0
    reserve: float = 0.0
    value: Any = None
    is_over: bool = False
    proof: bytes = b""
    until: float = 0.0
    reserved_until: float = 0.0
    touched_at: float = 0.0
    listeners: dict[Name, float] = field(default_factory=dict)

    @property
    def is_given_back(self) -> bool:
        """Whether the holder acts no more: at most its device still moves, until it is at rest."""
        return self.holder <= self.spent

    def hear_token(self, token: int, grantee: Name = "") -> None:
        """Take note of a token that others granted, to ``grantee`` where that is known."""
        if token > self.token:  # T1: the token never falls
            self.token, self.grantee = token, grantee

    def wake(self, now: float, lives: int) -> None:
        """Count leases anew from ``now`` on: their moments were on the clock of an earlier process."""
        self.touched_at = now
        self.until = now + self.ttl if self.holder != NONE else 0.0  # R2: a restart shortens no lease
        self.reserved_until = now + self.reserve
        self.ceiling = Ceiling(now, lives, self.promised.counter, self.token)
