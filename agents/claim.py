"""Claim: the body and the lease that one agent has for one task, or asks for."""

from __future__ import annotations

from collections.abc import Sequence

from twisted.internet.defer import Deferred, succeed

from middleware.consensus.lease.lessee import Lease, Lessee
from middleware.entangled.contact import Contact
from middleware.entangled.errors import EntangledError

STANDBYS = 2
"""Agents that wait and are ready to take over at once: each asks the council now and then."""
INSISTING_S = 1.0
"""An agent that is to act, and has no lease, reports again after this time: the holder may think that it gave up."""


class Claim:
    """One agent's claim; without a ``lessee`` it has no body for the task, and claims nothing.

    ``is_lent`` says that another task of the group has the body, so that the agent reports and decides all the same.
    ``token`` is the highest token that the body has obeyed so far, ``standbys`` the uuids of those next in line, and
    ``successors`` are the members of the council that is to follow.  ``released`` fires when the council knows that the
    lease was handed over.
    """

    def __init__(self, token: int) -> None:
        self.lessee: Lessee | None = None
        self.is_lent = False
        self.token = token
        self.standbys: tuple[str, ...] = ()
        self.successors: tuple[Contact, ...] = ()
        self.released: Deferred[object] = succeed(None)
        self._insists_at = 0.0
        self._moved_by = 0.0
        self._stands_at = 0.0

    @property
    def lease(self) -> Lease | None:
        """The lease if it is held now."""
        return None if self.lessee is None else self.lessee.lease

    def raise_token(self, token: int) -> None:
        """Take in that the body has obeyed ``token``: nothing older than that does it obey now."""
        self.token = max(self.token, token)
        if self.lessee is not None:
            self.lessee.outrank(self.token)

    def is_moving(self, now: float) -> bool:
        """Whether the lease is on its way to another council, and may still come back."""
        return self.lease is None and now < self._moved_by

    def want(self) -> None:
        """Claim the lease, or keep it."""
        if self.lessee is not None:
            self.lessee.want()

    def begin(self, now: float) -> None:
        """Claim the lease, and begin to wait for it."""
        if self.lessee is not None:
            self.lessee.want()
            self._insists_at = now + INSISTING_S

    def insist(self, now: float) -> bool:
        """Claim the lease; whether the others are to be told so again."""
        if self.lessee is None or now < self._insists_at:
            self.want()
            return False
        self.begin(now)
        return True

    def stand_by(self, rank: int) -> None:
        """Be ready to take over at once, where few are before this agent (``rank`` is from 1; 0: it is in no line)."""
        if self.lessee is not None and rank > 0:
            self.lessee.stand_by(rank)
        elif self.lessee is not None:
            self.lessee.release()

    def stop(self, moves_for: float, now: float) -> None:
        """Take in that the body was stopped, and may still move for some seconds because it did not hear that."""
        self._stands_at = now + moves_for

    def release(self, now: float, standbys: Sequence[Contact] = ()) -> Deferred[object]:
        """Give the lease back, or stop claiming it; with the seconds for which the body may still move."""
        if self.lessee is None:
            return succeed(None)
        return self.lessee.release(standbys, max(0.0, self._stands_at - now))

    def move(self, now: float, ttl: float) -> None:
        """Have the council changed; the lease comes back within ``ttl``, or is lost."""
        members, self.successors = self.successors, ()
        self._moved_by = now + ttl
        if self.lessee is not None:
            self.lessee.move(members).addErrback(lambda failure: failure.trap(EntangledError))
