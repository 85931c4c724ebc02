"""Renewal of certificates: bootstrap nodes renew present members, so a team keeps running without its operator.

Members do not ask for renewal.  Every few minutes each bootstrap node scans the membership list.  It signs a new end
date for members that are present, are not revoked, have a renewable certificate, and have a third of its life left.
The renewal is distributed by gossip.  Bootstrap nodes renew each other early enough that their end dates stay close
together; the last one renews itself.
"""

from __future__ import annotations

import random
from collections.abc import Callable

from twisted.logger import Logger

from middleware.admission.certificate import BOOTSTRAP, Member, member_of, renewed
from middleware.admission.roll import STEP, Roll, packed_admission
from middleware.entangled.errors import Full, RemoteError
from middleware.entangled.identity import Identity
from middleware.entangled.wire.door import Noted

SCANNED_S = 600.0
"""Mean seconds between two scans of the list.  Less renews members sooner that are present only briefly."""
LEFT = 3
"""A certificate is renewed when less than 1/``LEFT`` of its life is left."""
BATCH = 8
"""Renewals signed per scan: the renewals of a team that was founded in one day are spread over hours."""


class Renewer:
    """Renew certificates at one node, if it may; ``now`` is in seconds of the wall clock.

    ``pass_of`` returns the pass of a member, and ``add`` publishes an entry.
    """

    _log = Logger()

    def __init__(
        self,
        roll: Roll,
        identity: Identity,
        pass_of: Callable[[bytes], bytes],
        add: Callable[[bytes], object],
        rng: random.Random,
    ) -> None:
        self._roll = roll
        self._identity = identity
        self._pass_of = pass_of
        self._add = add
        self._rng = rng
        self._next_at = 0.0
        self._noted = Noted()

    def is_time(self, now: float) -> bool:
        """Return whether a scan is due, and draw the time of the next one, so that nodes scan at different times."""
        if now < self._next_at <= now + 2 * SCANNED_S:
            return False
        is_first, wait = not self._next_at, SCANNED_S
        self._next_at = now + (wait if is_first else wait * (0.5 + self._rng.random()))
        return not is_first

    def find_due(self, now: float) -> list[Member]:
        """Return the members that this node may renew and that are due; the caller selects the present ones."""
        own = self._identity.public
        me, grant = self._roll.member(own, now), self._roll.granted(own)
        if me is None or grant is None or self._roll.refusal(me, now):
            return []
        if BOOTSTRAP not in grant[0].roles or not me.is_renewable:
            return []
        members = self._roll.members(now)
        latest = max(each.not_after for each in members if BOOTSTRAP in each.roles)
        return [
            each
            for each in members
            if each.is_renewable and self._is_due(each, latest, now)
            if each.public != own or self._roll.is_last_bootstrap(own, now, now)
        ]

    def renew(self, member: Member, now: float) -> bool:
        """Sign a new end date for ``member`` and publish it; returns whether that succeeded."""
        grant, shown = self._roll.granted(self._identity.public), self._pass_of(member.public)
        try:
            if grant is None or not shown:
                return False
            before = member_of(self._roll.operator, member.public, shown)
            after = renewed(self._identity, grant[1], before, shown, int(now))
            member_of(self._roll.operator, member.public, after)
            self._add(packed_admission(member.public, after))
        except (RemoteError, Full) as error:
            if self._noted.is_new(now, member.public):
                self._log.warn("cannot renew the certificate of {name}: {error}", name=member.name, error=error)
            return False
        return True

    def pick(self, due: list[Member]) -> list[Member]:
        """Draw the members that are renewed in this scan."""
        return self._rng.sample(due, min(len(due), BATCH))

    @staticmethod
    def _is_due(member: Member, latest: int, now: float) -> bool:
        """Return whether little of the certificate is left, or a bootstrap node's ends well before ``latest``."""
        end = now + member.life
        if end < member.not_after + STEP:
            return False
        is_behind = BOOTSTRAP in member.roles and min(latest, end) > member.not_after + STEP
        return member.not_after - now < member.life / LEFT or is_behind
