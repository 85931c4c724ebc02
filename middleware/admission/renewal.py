"""Renewal of certificates: bootstrap nodes renew present members, so a team keeps running without its operator.

Members do not ask for renewal.  Every few minutes each bootstrap node scans the membership list.  It signs a new end
date for each member that is present and not revoked, if the member's certificate is renewable and less than a third of
its validity remains.  The renewal is distributed by gossip.  Bootstrap nodes renew each other early enough that their
end dates stay close together; the last one renews itself.
"""

from __future__ import annotations

import random
from collections.abc import Callable

from twisted.logger import Logger

from middleware.admission.certificate import BOOTSTRAP, Member, renew_certificate, verify_certificate
from middleware.admission.membership_list import MIN_RENEWAL_S, MembershipList, pack_admission
from middleware.entangled.errors import Full, RemoteError
from middleware.entangled.identity import Identity
from middleware.entangled.wire.admission_check import LogLimiter

SCAN_INTERVAL_S = 600.0
"""Mean seconds between two scans of the list; with a shorter time, members that are present only briefly are renewed
sooner."""
RENEWAL_DIVISOR = 3
"""A certificate is renewed when less than 1/``RENEWAL_DIVISOR`` of its validity remains."""
MAX_RENEWALS_PER_SCAN = 8
"""Renewals signed per scan: the renewals of a team that was founded in one day are spread over hours."""


class Renewer:
    """Renews certificates at one node, if its role permits this; ``now`` is in seconds of the wall clock.

    ``find_certificate`` returns the certificate of a member, and ``add`` publishes an entry.
    """

    _log = Logger()

    def __init__(
        self,
        membership_list: MembershipList,
        identity: Identity,
        find_certificate: Callable[[bytes], bytes],
        add: Callable[[bytes], object],
        rng: random.Random,
    ) -> None:
        self._membership_list = membership_list
        self._identity = identity
        self._find_certificate = find_certificate
        self._add = add
        self._rng = rng
        self._next_at = 0.0
        self._log_limiter = LogLimiter()

    def is_scan_due(self, now: float) -> bool:
        """Return whether a scan is due, and draw the time of the next one, so that nodes scan at different times."""
        if now < self._next_at <= now + 2 * SCAN_INTERVAL_S:
            return False
        is_first, wait = not self._next_at, SCAN_INTERVAL_S
        self._next_at = now + (wait if is_first else wait * (0.5 + self._rng.random()))
        return not is_first

    def find_due_members(self, now: float) -> list[Member]:
        """Return the members that this node may renew and that are due; the caller selects the present ones."""
        own = self._identity.public
        me, grant = self._membership_list.find_member(own, now), self._membership_list.find_grant(own)
        if me is None or grant is None or self._membership_list.find_refusal(me, now):
            return []
        if BOOTSTRAP not in grant[0].roles or not me.is_renewable:
            return []
        members = self._membership_list.list_members(now)
        latest = max(each.not_after for each in members if BOOTSTRAP in each.roles)
        return [
            each
            for each in members
            if each.is_renewable and self._is_due(each, latest, now)
            if each.public != own or self._membership_list.is_last_bootstrap(own, now, now)
        ]

    def renew(self, member: Member, now: float) -> bool:
        """Sign a new end date for ``member`` and publish it; returns whether that succeeded."""
        grant, certificate = (
            self._membership_list.find_grant(self._identity.public),
            self._find_certificate(member.public),
        )
        try:
            if grant is None or not certificate:
                return False
            before = verify_certificate(self._membership_list.operator, member.public, certificate)
            after = renew_certificate(self._identity, grant[1], before, certificate, int(now))
            verify_certificate(self._membership_list.operator, member.public, after)
            self._add(pack_admission(member.public, after))
        except (RemoteError, Full) as error:
            if self._log_limiter.should_log(now, member.public):
                self._log.warn("cannot renew the certificate of {name}: {error}", name=member.name, error=error)
            return False
        return True

    def pick(self, due: list[Member]) -> list[Member]:
        """Draw the members that are renewed in this scan."""
        return self._rng.sample(due, min(len(due), MAX_RENEWALS_PER_SCAN))

    @staticmethod
    def _is_due(member: Member, latest: int, now: float) -> bool:
        """Return whether the certificate ends soon, or is a bootstrap node's and ends well before ``latest``."""
        end = now + member.life
        if end < member.not_after + MIN_RENEWAL_S:
            return False
        is_behind = BOOTSTRAP in member.roles and min(latest, end) > member.not_after + MIN_RENEWAL_S
        return member.not_after - now < member.life / RENEWAL_DIVISOR or is_behind
