"""Caretaker: sees to it that the council of a task is filled up when a member of it is gone.

It falls to whoever acts, and before anybody does to the first of those present (consensus rules 1 and 2).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from twisted.internet.defer import Deferred
from twisted.internet.interfaces import IReactorTime

from agents.engagement import Engagement
from middleware.entangled.contact import Contact
from middleware.entangled.errors import EntangledError
from middleware.node import SwarmNode

if TYPE_CHECKING:
    from middleware.consensus.lease.council import Council

VISIT = 5.0
"""Seconds between two looks; a council that nobody asks for a lease is asked then whether it is there."""
AGAIN = 10.0
"""Seconds until a successor is looked for again where there was none."""


class Caretaker:
    """The one for ``engagement``, in the name of ``node``."""

    def __init__(self, engagement: Engagement, node: SwarmNode, clock: IReactorTime) -> None:
        self._engagement = engagement
        self._node = node
        self._clock = clock
        self._council: Council | None = None
        self._visit_at = clock.seconds() + VISIT
        self._look_at = 0.0

    def look(self) -> None:
        """Look after the council, if it falls to this agent."""
        engagement, now = self._engagement, self._clock.seconds()
        if now < self._visit_at or not engagement.keeps_council:
            return
        self._visit_at = now + VISIT
        lessee = engagement.lessee if engagement.is_acting else None
        council = self._visited() if lessee is None else lessee.council
        if now >= self._look_at and self._node.councils.has_vacancy(engagement.task, council):
            self._look_at = now + AGAIN
            following = Deferred.fromCoroutine(self._node.councils.successors(engagement.task, council))
            following.addCallback(self._found, council).addErrback(_nobody)

    def _visited(self) -> Council:
        """The council that nobody asks for a lease, asked whether it is there."""
        task = self._engagement.task
        if self._council is None:
            self._council = self._node.councils.of(task)
        self._council.learn(task.charter)
        self._council.visit()
        return self._council

    def _found(self, members: tuple[Contact, ...] | None, council: Council) -> object:
        if members is not None and council is self._council:
            return council.change(members)
        if members is not None:
            self._engagement.hand_council(members)
        return None


def _nobody(failure: Any) -> None:
    """Too few answer just now, or somebody claims the lease: it is tried again."""
    failure.trap(EntangledError)
