"""An agent's claim on a task's lease, and the robot's fencing token."""

from __future__ import annotations

from collections.abc import Sequence

from twisted.internet.defer import Deferred, succeed

from middleware.consensus.lease.lease_client import Lease, LeaseClient
from middleware.entangled.contact import Contact
from middleware.entangled.errors import EntangledError

STANDBYS = 2
"""Number of standbys: agents that poll the quorum members so that they can take over immediately."""
REPORT_AGAIN_S = 1.0
"""Seconds after which an assigned agent without a lease reports again, since the holder may have missed its report."""


class TaskLease:
    """One agent's claim on the lease; without a robot for the task, ``lease_client`` is None and it claims nothing.

    - ``is_lent``: another task of the group uses the robot; the agent still reports and decides
    - ``token``: the highest fencing token that the robot has obeyed
    - ``standbys``: the uuids of the standbys, the best first
    - ``next_members``: the members of the next quorum of the task
    - ``when_released``: fires when the quorum members have been notified of the release
    """

    def __init__(self, token: int) -> None:
        self.lease_client: LeaseClient | None = None
        self.is_lent = False
        self.token = token
        self.standbys: tuple[str, ...] = ()
        self.next_members: tuple[Contact, ...] = ()
        self.when_released: Deferred[object] = succeed(None)
        self._report_again_at = 0.0
        self._council_change_ends_at = 0.0
        self._stands_still_at = 0.0

    @property
    def lease(self) -> Lease | None:
        """The lease if it is held now, otherwise None."""
        return None if self.lease_client is None else self.lease_client.lease

    def raise_token(self, token: int) -> None:
        """Record that the robot has obeyed ``token``; the robot rejects lower tokens from now on."""
        self.token = max(self.token, token)
        if self.lease_client is not None:
            self.lease_client.on_higher_token(self.token)

    def is_changing_council(self, now: float) -> bool:
        """Return whether the quorum is being changed and the lease may still be granted again."""
        return self.lease is None and now < self._council_change_ends_at

    def request(self) -> None:
        """Claim the lease, or continue to renew it."""
        if self.lease_client is not None:
            self.lease_client.claim()

    def start_request(self, now: float) -> None:
        """Claim the lease and start the timer of ``retry_request``."""
        if self.lease_client is not None:
            self.lease_client.claim()
            self._report_again_at = now + REPORT_AGAIN_S

    def retry_request(self, now: float) -> bool:
        """Claim the lease; return whether the report has to be sent again."""
        if self.lease_client is None or now < self._report_again_at:
            self.request()
            return False
        self.start_request(now)
        return True

    def stand_by(self, rank: int) -> None:
        """Poll as a standby of this ``rank`` (from 1), or stop claiming the lease (0)."""
        if self.lease_client is not None and rank > 0:
            self.lease_client.stand_by(rank)
        elif self.lease_client is not None:
            self.lease_client.release()

    def record_stop(self, moves_for: float, now: float) -> None:
        """Record that the robot was stopped but may move for ``moves_for`` more seconds, because it did not confirm."""
        self._stands_still_at = now + moves_for

    def release(self, now: float, standbys: Sequence[Contact] = ()) -> Deferred[object]:
        """Release the lease, or stop claiming it; other agents wait as long as this robot may still move."""
        if self.lease_client is None:
            return succeed(None)
        return self.lease_client.release(standbys, max(0.0, self._stands_still_at - now))

    def change_council(self, now: float, ttl: float) -> None:
        """Change the quorum to ``next_members``; the lease is granted again within ``ttl`` seconds, or is lost."""
        members, self.next_members = self.next_members, ()
        self._council_change_ends_at = now + ttl
        if self.lease_client is not None:
            self.lease_client.change_council(members).addErrback(lambda failure: failure.trap(EntangledError))
