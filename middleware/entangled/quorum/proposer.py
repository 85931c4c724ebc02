"""The proposer: it prepares, completes what was accepted before or proposes its own value, and backs off."""

from __future__ import annotations

import random
from collections.abc import Awaitable, Callable
from enum import Enum
from typing import Any, NamedTuple

from middleware.entangled.quorum.ballot import Ballot, Name
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


class Proposer:
    """One proposer of one register; ``prepare`` and ``accept`` each ask every member under a ballot.

    ``release`` gives a ballot back under which nothing is to be proposed.
    """

    def __init__(
        self,
        name: Name,
        prepare: Callable[[Ballot], Awaitable[Outcome]],
        accept: Callable[[Ballot, Any], Awaitable[Outcome]],
        release: Callable[[Ballot], object],
        counter: int = 0,
    ) -> None:
        self._name = name
        self._prepare = prepare
        self._accept = accept
        self._release = release
        self._counter = counter

    async def decide(self, value: Any, sleep: Callable[[float], Awaitable[object]], rng: random.Random) -> Any:
        """See the decision through, whatever it takes, and return it.

        ``value`` is proposed where nothing else was; with None nothing is, and None is returned where nothing was
        accepted.  Ends only when a majority has decided, or with what ``sleep`` raises.
        """
        pause = BACK_OFF[0]
        while True:
            outcome = await self._attempt(value)
            if outcome is None or outcome.result is Result.DECIDED:
                return outcome and outcome.value
            # Not for the whole of another's lease: it may end sooner, or with a decision.
            await sleep(max(min(outcome.remaining, BACK_OFF[1]), pause * (0.5 + rng.random())))
            pause = min(2 * pause, BACK_OFF[1])

    async def _attempt(self, value: Any) -> Outcome | None:
        """Both phases under a ballot above all that were seen; None where there is nothing to propose."""
        ballot = Ballot(self._counter + 1, self._name)
        prepared = await self._prepare(ballot)
        self._counter = max(ballot.counter, prepared.counter)
        if prepared.result is not Result.WON:
            return prepared
        chosen = value if prepared.value is None else prepared.value  # A2
        if chosen is None:
            self._release(ballot)
            return None
        accepted = await self._accept(ballot, chosen)
        self._counter = max(self._counter, accepted.counter)
        return Outcome(Result.DECIDED, chosen) if accepted.result is Result.WON else accepted
