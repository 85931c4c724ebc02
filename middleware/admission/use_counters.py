"""Use counters of invitations: each use is a tuple in the team's tuple space, which can be taken at most once.

This holds for any number of bootstrap nodes, crashes and partitions.  A bootstrap node that reaches too few members
cannot take a use, and reports this.
"""

from __future__ import annotations

import random

from twisted.internet.defer import Deferred, FirstError, gatherResults
from twisted.internet.interfaces import IReactorTime
from twisted.python.failure import Failure

from middleware.admission.membership_list import invitation_id
from middleware.admission.statement import Invite
from middleware.entangled.node import EntangledNode
from middleware.entangled.space.tuplespace import TupleSpace

SPACE_NAME = "admission"


class UseCounters:
    """The use counters of all invitations, accessed from one node."""

    def __init__(self, node: EntangledNode, clock: IReactorTime, rng: random.Random) -> None:
        self._space = TupleSpace(node, clock, rng, SPACE_NAME)

    def issue(self, invite: Invite) -> Deferred[list[None]]:
        """Put one tuple per use of ``invite``; fires when a majority stored them, fails with a ``TransientError``."""
        name = invitation_id(invite.public)
        puts = [self._space.put((name, number)) for number in range(invite.uses)]
        return gatherResults(puts, consumeErrors=True).addErrback(_unwrap_first_error)

    def take(self, invite: Invite) -> Deferred[bool]:
        """Take one use of ``invite``; fire with False if no use remains.

        Fails with ``TransientError`` if too few members answer.
        """
        taken = self._space.get_if_exists((invitation_id(invite.public), int))
        return taken.addCallback(lambda found: found is not None)

    def stop(self) -> None:
        """Cancel pending operations."""
        self._space.stop()


def _unwrap_first_error(failure: Failure) -> Failure:
    """Return the original failure instead of the ``FirstError`` around it."""
    return failure.value.subFailure if isinstance(failure.value, FirstError) else failure
