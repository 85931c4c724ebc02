"""Patience: a member that is asked for a lease just before the one before it ends answers when it does."""

from __future__ import annotations

from collections.abc import Callable

from twisted.internet.defer import Deferred
from twisted.internet.interfaces import IReactorTime
from twisted.internet.task import deferLater

from middleware.entangled.quorum.register import Kind, Reply

MOST = 0.15
"""Seconds for which an answer is put off."""
LEAST = 0.001
"""Seconds that pass at least until a proposal is looked at again."""


def in_time(propose: Callable[[], Reply], clock: IReactorTime) -> Deferred[Reply]:
    """What ``propose`` brings: now, or in a moment where only the end of another's lease is missing.

    So neither a round trip nor a guess at its length lies between the end of one lease and the next.
    """
    return Deferred.fromCoroutine(_in_time(propose, clock))


async def _in_time(propose: Callable[[], Reply], clock: IReactorTime) -> Reply:
    reply = propose()
    while reply.kind is Kind.HELD and reply.remaining <= MOST:
        await deferLater(clock, max(LEAST, reply.remaining))
        reply = propose()
    return reply
