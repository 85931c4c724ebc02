"""The proposer: it prepares, completes what was accepted before or proposes its own value, and backs off."""

from __future__ import annotations

import random
from collections.abc import Awaitable, Callable
from enum import Enum
from typing import Any, NamedTuple

from middleware.entangled.quorum.ballot import Ballot
from middleware.entangled.quorum.register import Kind
from middleware.entangled.quorum.round import Tally

BACK_OFF = (0.05, 2.0)
"""Seconds of the first and of the longest pause between two attempts; each is twice the one before it."""


class Result(Enum):
    """How a round ended."""

    WON = "won"
    """A majority agrees."""
    DECIDED = "decided"
    """``value`` was decided, by whichever proposer."""
    HELD = "held"
    OUTBID = "outbid"
    SILENT = "silent"
    """Too few members answered."""


class Outcome(NamedTuple):
    """The end of a round.

    ``value``: of ``DECIDED`` what was decided; of ``WON`` what must be proposed instead of an own value, if anything.
    ``counter``: the highest promised.  ``remaining``: seconds until what another holds runs out.
    """

    result: Result
    value: Any = None
    counter: int = 0
    remaining: float = 0.0


def conclude(tally: Tally) -> Outcome:
    """What the answers of a round say, at its end."""
    replies = tally.replies.values()
    counter = max((reply.promised.counter for reply in replies), default=0)
    if tally.chosen is not None:
        return Outcome(Result.DECIDED, tally.chosen, counter)
    if tally.is_won:
        return Outcome(Result.WON, tally.to_complete, counter)
    remaining = max((reply.remaining for reply in replies if reply.kind is Kind.HELD), default=0.0)
    kinds = [reply.kind for reply in replies]
    if Kind.OUTBID in kinds:
        return Outcome(Result.OUTBID, None, counter, remaining)
    return Outcome(Result.HELD if Kind.HELD in kinds else Result.SILENT, None, counter, remaining)


async def decide(
    ballot: Ballot,
    value: Any,
    prepare: Callable[[Ballot], Awaitable[Outcome]],
    accept: Callable[[Ballot, Any], Awaitable[Outcome]],
    sleep: Callable[[float], Awaitable[None]],
    rng: random.Random,
) -> tuple[Ballot, Any]:
    """See a decision through, from ``ballot`` on, whatever it takes; return the last ballot and what was decided.

    ``value`` is proposed where nothing else was; with None nothing is, and None is returned where nothing was accepted.
    """
    pause = BACK_OFF[0]
    while True:
        outcome = await prepare(ballot)
        counter = max(ballot.counter, outcome.counter)
        if outcome.result is Result.WON:
            chosen = value if outcome.value is None else outcome.value  # A2
            if chosen is None:
                return ballot, None
            outcome = await accept(ballot, chosen)
            counter = max(counter, outcome.counter)
            if outcome.result is Result.WON:
                return ballot, chosen
        if outcome.result is Result.DECIDED:
            return ballot, outcome.value
        # Not for the whole of another's lease: it may end sooner, or with a decision.
        await sleep(max(min(outcome.remaining, BACK_OFF[1]), pause * (0.5 + rng.random())))
        pause = min(2 * pause, BACK_OFF[1])
        ballot = Ballot(counter + 1, ballot.proposer)
