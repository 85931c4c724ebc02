"""The proposer: prepares a ballot, completes an accepted value or proposes its own, and backs off."""

from __future__ import annotations

import random
from collections.abc import Awaitable, Callable
from enum import Enum
from typing import Any, NamedTuple

from middleware.entangled.quorum.ballot import Ballot
from middleware.entangled.quorum.register import ReplyKind
from middleware.entangled.quorum.round import Tally

BACKOFF_S = (0.05, 2.0)
"""Seconds of the first and the longest pause between two attempts; the pause doubles each time."""


class Result(Enum):
    """The result of a round."""

    WON = "won"
    """A majority agrees."""
    DECIDED = "decided"
    """A majority has accepted ``value``, which any proposer may have proposed."""
    HELD = "held"
    OUTBID = "outbid"
    SILENT = "silent"
    """Too few members answered."""


class Outcome(NamedTuple):
    """The end of a round.

    ``value`` is the decided value (``DECIDED``), or the value that must be proposed, if any (``WON``).  ``counter`` is
    the highest promised counter.  ``remaining`` is the time in seconds until another proposer's lease expires.
    """

    result: Result
    value: Any = None
    counter: int = 0
    remaining: float = 0.0


def conclude(tally: Tally) -> Outcome:
    """Return the outcome of a finished round."""
    replies = tally.replies.values()
    counter = max((reply.promised.counter for reply in replies), default=0)
    if tally.chosen_value is not None:
        return Outcome(Result.DECIDED, tally.chosen_value, counter)
    if tally.is_won:
        return Outcome(Result.WON, tally.value_to_complete, counter)
    remaining = max((reply.remaining for reply in replies if reply.kind is ReplyKind.HELD), default=0.0)
    kinds = [reply.kind for reply in replies]
    if ReplyKind.OUTBID in kinds:
        return Outcome(Result.OUTBID, None, counter, remaining)
    return Outcome(Result.HELD if ReplyKind.HELD in kinds else Result.SILENT, None, counter, remaining)


async def decide(
    ballot: Ballot,
    value: Any,
    prepare: Callable[[Ballot], Awaitable[Outcome]],
    accept: Callable[[Ballot, Any], Awaitable[Outcome]],
    sleep: Callable[[float], Awaitable[None]],
    rng: random.Random,
) -> tuple[Ballot, Any]:
    """Retry from ``ballot`` on until a value is decided; return the last ballot and the decided value.

    Proposes ``value`` if no other value was accepted.  If ``value`` is None, no new value is proposed, and the decided
    value is None if no value was accepted.
    """
    pause = BACKOFF_S[0]
    while True:
        outcome = await prepare(ballot)
        counter = max(ballot.counter, outcome.counter)
        if outcome.result is Result.WON:
            chosen = value if outcome.value is None else outcome.value  # A2: an accepted value takes precedence
            if chosen is None:
                return ballot, None
            outcome = await accept(ballot, chosen)
            counter = max(counter, outcome.counter)
            if outcome.result is Result.WON:
                return ballot, chosen
        if outcome.result is Result.DECIDED:
            return ballot, outcome.value
        # The pause is limited, because another proposer's lease may be released early or end in a decision.
        await sleep(max(min(outcome.remaining, BACKOFF_S[1]), pause * (0.5 + rng.random())))
        pause = min(2 * pause, BACKOFF_S[1])
        ballot = Ballot(counter + 1, ballot.proposer)
