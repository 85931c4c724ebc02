"""An agent's claim on a task's lease, and the robot's fencing token."""

from __future__ import annotations

from collections.abc import Sequence

from twisted.internet.defer import Deferred, succeed

from middleware.consensus.lease.lessee import Lease, Lessee
from middleware.entangled.contact import Contact
from middleware.entangled.errors import EntangledError

STANDBYS = 2
"""Number of standbys: agents that poll the quorum members to take over at once."""
INSISTING_S = 1.0
"""Seconds after which an assigned agent without a lease reports again, since the holder may have missed its report."""


class Claim:
    """One agent's claim; without a ``lessee`` the agent has no robot for the task and claims nothing.

    - ``is_lent``: another task of the group uses the robot; the agent still reports and decides
    - ``token``: the highest fencing token that the robot has obeyed
    - ``standbys``: the uuids of the standbys, the best first
    - ``successors``: the members of the next quorum
    - ``released``: fires when the quorum members know that the lease was handed over
    """

    def __init__(self, token: int) -> None:
        self.lessee: Lessee | None = None
        self.is_lent = False
        self.token = token
        self.standbys: tuple[str, ...] = ()
        self.successors: tuple[Contact, ...] = ()
        self.released: Deferred[object] = succeed(None)
        self._insists_at = 0.0
        self._move_ends_at = 0.0
        self._stopped_at = 0.0

    @property
    def lease(self) -> Lease | None:
        """The lease if it is held now, otherwise None."""
        return None if self.lessee is None else self.lessee.lease

    def raise_token(self, token: int) -> None:
        """Record that the robot has obeyed ``token``; it rejects lower ones from now on."""
        self.token = max(self.token, token)
        if self.lessee is not None:
            self.lessee.outrank(self.token)

    def is_moving(self, now: float) -> bool:
        """Return whether the lease is moving to another quorum, and may still return."""
        return self.lease is None and now < self._move_ends_at

    def want(self) -> None:
        """Claim the lease, or keep it."""
        if self.lessee is not None:
            self.lessee.want()

    def begin(self, now: float) -> None:
        """Claim the lease and start the timer of ``insist``."""
        if self.lessee is not None:
            self.lessee.want()
            self._insists_at = now + INSISTING_S

    def insist(self, now: float) -> bool:
        """Claim the lease; returns whether the report is due to be sent again."""
        if self.lessee is None or now < self._insists_at:
            self.want()
            return False
        self.begin(now)
        return True

    def stand_by(self, rank: int) -> None:
        """Poll as a standby of this ``rank`` (from 1), or stop claiming the lease (0)."""
        if self.lessee is not None and rank > 0:
            self.lessee.stand_by(rank)
        elif self.lessee is not None:
            self.lessee.release()

    def stop(self, moves_for: float, now: float) -> None:
        """Record that the robot was stopped but may move for ``moves_for`` more seconds, because it did not confirm."""
        self._stopped_at = now + moves_for

    def release(self, now: float, standbys: Sequence[Contact] = ()) -> Deferred[object]:
        """Release the lease, or stop claiming it; other agents wait while the robot may still move."""
        if self.lessee is None:
            return succeed(None)
        return self.lessee.release(standbys, max(0.0, self._stopped_at - now))

    def move(self, now: float, ttl: float) -> None:
        """Change the quorum to ``successors``; the lease is granted again within ``ttl`` seconds, or is lost."""
        members, self.successors = self.successors, ()
        self._move_ends_at = now + ttl
        if self.lessee is not None:
            self.lessee.move(members).addErrback(lambda failure: failure.trap(EntangledError))
