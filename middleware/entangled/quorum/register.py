"""The state of one register at an acceptor, and the acceptor's replies; plain data."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum
from typing import Any, NamedTuple

from middleware.entangled.quorum.ballot import FIRST_CONFIGURATION, NO_BALLOT, Ballot, Ceiling, ProposerName


class ReplyKind(Enum):
    """The kind of an acceptor's reply."""

    GRANTED = "granted"
    HELD = "held"
    """Another proposer's lease or reservation expires in ``remaining`` seconds."""
    OUTBID = "outbid"
    """A higher ballot was promised, a higher token was granted, or the ballot was released."""
    UNPREPARED = "unprepared"
    """The register or the ballot is unknown here: prepare first."""
    QUIET = "quiet"
    """The acceptor may have forgotten a grant, or has no space; ask again in ``remaining`` seconds."""
    BEHIND = "behind"
    """The acceptor does not know the requested configuration yet."""
    SEALED = "sealed"
    """The ballot is promised, but a value was already accepted: only this value may be proposed."""
    MOVED = "moved"
    """The requested configuration was replaced; ``configuration`` and ``proof`` describe the current one."""
    OVER = "over"
    """The register is closed."""


class Reply(NamedTuple):
    """The reply of an acceptor; ``remaining`` is a number of seconds after the reply.

    ``promised`` is the highest promised ballot, ``token`` the highest granted token; ``value`` was accepted under the
    ballot ``accepted``.  ``proof`` is the certificate of the configuration in a ``MOVED`` reply, or a signature of the
    acceptor.
    """

    kind: ReplyKind
    promised: Ballot = NO_BALLOT
    token: int = 0
    remaining: float = 0.0
    configuration: int = 0
    accepted: Ballot = NO_BALLOT
    value: Any = None
    proof: bytes = b""


@dataclass(slots=True)
class Register:
    """The promises, the lease and the accepted value of one register at an acceptor.

    ``promised`` is the highest promised ballot, reserved for ``reserve`` seconds, until ``reserved_until``.  ``holder``
    is the ballot of the lease, granted for ``ttl`` seconds, until ``lease_until``.  ``released`` is the highest
    released ballot.  ``token`` is the fencing token; ``grantee`` is the proposer to which this acceptor granted it, or
    empty if other acceptors reported the token.  ``value`` was accepted under ``accepted``; if that is ``NO_BALLOT``,
    ``value`` is the newest configuration that this acceptor knows, and ``proof`` is the certificate of that
    configuration.  Times are on the clock of one process and are not stored.
    """

    ceiling: Ceiling
    configuration: int = FIRST_CONFIGURATION
    promised: Ballot = NO_BALLOT
    holder: Ballot = NO_BALLOT
    released: Ballot = NO_BALLOT
    accepted: Ballot = NO_BALLOT
    token: int = 0
    grantee: ProposerName = ""
    ttl: float = 0.0
    reserve: float = 0.0
    value: Any = None
    is_closed: bool = False
    proof: bytes = b""
    lease_until: float = 0.0
    reserved_until: float = 0.0
    touched_at: float = 0.0
    listeners: dict[ProposerName, float] = field(default_factory=dict)

    @property
    def is_released(self) -> bool:
        """Whether the holder has released the lease; its device may still move until it is at rest."""
        return self.holder <= self.released

    def record_token(self, token: int, grantee: ProposerName = "") -> None:
        """Record a token that other acceptors granted, to ``grantee`` if known."""
        if token > self.token:  # T1: the token never decreases
            self.token, self.grantee = token, grantee

    def restart_leases(self, now: float, lives: int) -> None:
        """Restart all leases at ``now``, because their times were on the clock of an earlier process."""
        self.touched_at = now
        self.lease_until = now + self.ttl if self.holder != NO_BALLOT else 0.0  # R2: a restart shortens no lease
        self.reserved_until = now + self.reserve
        self.ceiling = Ceiling(now, lives, self.promised.counter, self.token)
