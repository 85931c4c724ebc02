"""Uses: how often an invitation may be used, as tuples in the team's own space: each is taken at most once.

So it does not matter how many bootstrap nodes there are, nor who dies or is cut off meanwhile; and a bootstrap node
that sees too few of the team cannot tell, and says so.
"""

from __future__ import annotations

import random

from twisted.internet.defer import Deferred, FirstError, gatherResults
from twisted.internet.interfaces import IReactorTime
from twisted.python.failure import Failure

from middleware.admission.roll import invitation_id
from middleware.admission.statement import Invite
from middleware.entangled.node import EntangledNode
from middleware.entangled.space.tuplespace import TupleSpace

SPACE = "admission"


class Uses:
    """The uses of all invitations, seen from one node."""

    def __init__(self, node: EntangledNode, clock: IReactorTime, rng: random.Random) -> None:
        self._space = TupleSpace(node, clock, rng, SPACE)

    def issue(self, invite: Invite) -> Deferred[list[None]]:
        """Make ``invite`` usable as often as it says; fires when a majority knows, fails with a ``WeatherError``."""
        name = invitation_id(invite.public)
        puts = [self._space.put((name, number)) for number in range(invite.uses)]
        return gatherResults(puts, consumeErrors=True).addErrback(_first)

    def take(self, invite: Invite) -> Deferred[bool]:
        """Use ``invite`` once; whether that was possible.  Fails with a ``WeatherError`` where nobody can tell."""
        taken = self._space.get_if_exists((invitation_id(invite.public), int))
        return taken.addCallback(lambda found: found is not None)

    def stop(self) -> None:
        """End what is under way."""
        self._space.stop()


def _first(failure: Failure) -> Failure:
    """What went wrong itself: a ``FirstError`` is no line for a person."""
    return failure.value.subFailure if isinstance(failure.value, FirstError) else failure
