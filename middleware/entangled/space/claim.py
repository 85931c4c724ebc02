"""Claim: a tuple that is held under a lease and not yet taken."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from twisted.internet.defer import Deferred

from middleware.entangled.errors import Refused
from middleware.entangled.quorum.ballot import Ballot
from middleware.entangled.space.posting import Posted
from middleware.entangled.space.template import Tuple


class ClaimLost(Refused):
    """The tuple was taken by another; what was done about it must not count."""


@dataclass
class Claim:
    """The sole right to take a tuple, until ``deadline`` (seconds of the own clock); then others may claim it.

    Confirm it when the work is done.  Whoever does neither that nor renew loses it, which is how a tuple comes back
    from a taker that died.
    """

    posted: Posted
    ballot: Ballot
    lease: float
    deadline: float
    _confirm: Callable[[Claim], Deferred[Tuple]] = field(repr=False)
    _release: Callable[[Claim], None] = field(repr=False)
    _renew: Callable[[Claim], Deferred[None]] = field(repr=False)
    is_over: bool = False

    @property
    def fields(self) -> Tuple:
        """The tuple."""
        return self.posted.fields

    def confirm(self) -> Deferred[Tuple]:
        """Take the tuple for good; fires when the council has decided.

        Fails with ``ClaimLost`` where it decided for another, which can happen only after the deadline.  Cancelled
        meanwhile, the tuple is put back should the council decide for us.
        """
        return self._confirm(self)

    def release(self) -> None:
        """Give the tuple back at once."""
        self._release(self)

    def renew(self) -> Deferred[None]:
        """Hold the tuple for another lease from now; fails with ``ClaimLost``, or ``NoAnswer`` while time is left."""
        return self._renew(self)
