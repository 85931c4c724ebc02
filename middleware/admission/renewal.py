"""Renewal: a bootstrap node renews the certificates of the members in sight, so that a team goes on unattended.

Members ask for nothing.  Each bootstrap node looks over the membership list every few minutes; it signs a new end for
members that are present, that the operator did not revoke, whose certificate is renewable, and of whose life a third is
left.  The renewal goes to all by gossip.  Bootstrap nodes renew each other, and early enough that their ends stay
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
"""Seconds between two looks at the list, on average.  Less renews sooner whoever is present for a short while only."""
LEFT = 3
"""One part in so many of a certificate's life is left when it is renewed."""
BATCH = 8
"""Renewals that are signed at once: so a team that was founded in one day is renewed over hours."""


class Renewer:
    """Renews for one node, where that may; ``now`` is in seconds of the wall clock.

    ``pass_of`` gives the pass of a member, and ``add`` tells the team.
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
        """Whether to look over the list; the next time is drawn, so that several nodes do so one after the other."""
        if now < self._next_at <= now + 2 * SCANNED_S:
            return False
        is_first, wait = not self._next_at, SCANNED_S
        self._next_at = now + (wait if is_first else wait * (0.5 + self._rng.random()))
        return not is_first

    def find_due(self, now: float) -> list[Member]:
        """Return the members that this node may renew now and should; the present ones are for the caller to pick."""
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
        """Sign a new end for ``member`` and tell the team; whether that was possible."""
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
                self._log.warn("{name} cannot be renewed: {error}", name=member.name, error=error)
            return False
        return True

    def pick(self, due: list[Member]) -> list[Member]:
        """Draw those that are renewed at once."""
        return self._rng.sample(due, min(len(due), BATCH))

    @staticmethod
    def _is_due(member: Member, latest: int, now: float) -> bool:
        """Whether little is left of a certificate, or that of a bootstrap node would end well before ``latest``."""
        end = now + member.life
        if end < member.not_after + STEP:
            return False
        is_behind = BOOTSTRAP in member.roles and min(latest, end) > member.not_after + STEP
        return member.not_after - now < member.life / LEFT or is_behind
