"""Council: the conversation of a claimant with the members that are pinned in a tuple.

It asks, counts by ``Tally`` and sees a decree through to its end; it knows no node, only a way to ask a member.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Sequence
from typing import Any

from twisted.internet.defer import Deferred

from middleware.entangled.background import Background
from middleware.entangled.errors import EntangledError, NotRunning
from middleware.entangled.kademlia.contact import Contact
from middleware.entangled.space.decree import Ballot, Kind, Outcome, Result, Tally, reply_unpacked
from middleware.entangled.space.posting import Member, Posted

RESOLVE_LEASE = 2.0
BACK_OFF = (0.05, 2.0)

Ask = Callable[[Contact, str, tuple[object, ...]], "Deferred[Any]"]
"""Ask a member: (contact, method, arguments)."""


class Council:
    """How one claimant talks with councils; ``chores`` are its own, and end with it."""

    def __init__(self, ask: Ask, rng: random.Random, chores: Background) -> None:
        self._ask = ask
        self._rng = rng
        self._chores = chores

    async def claim(self, posted: Sequence[Posted], ballot: Ballot, lease: float) -> list[Outcome]:
        """One round of claims for tuples of one key and council; what was not won is given free again."""
        outcomes = await self.renew(posted, ballot, lease)
        lost = [p for p, o in zip(posted, outcomes, strict=True) if o.result not in (Result.WON, Result.DECIDED)]
        if lost:
            # What a minority promised must not keep a luckier claimant waiting.
            self.release(lost, ballot)
        return outcomes

    async def renew(self, posted: Sequence[Posted], ballot: Ballot, lease: float) -> list[Outcome]:
        """One round of claims under a ballot that has won before; where it fails, what is left of the lease stays."""
        return await self._round(posted, "decree.claim", Kind.PROMISED, ballot, lease)

    async def confirm(self, posted: Sequence[Posted], ballot: Ballot, value: bytes) -> list[Outcome]:
        """One round of confirmation, of tuples of one key and council."""
        return await self._round(posted, "decree.confirm", Kind.ACCEPTED, ballot, value)

    def release(self, posted: Sequence[Posted], ballot: Ballot) -> None:
        """Give leases back, as far as the members can be heard; the others let them run out."""
        for member in posted[0].council:
            asked = self._ask(member.contact, "decree.release", _arguments(posted, member, ballot))
            asked.addErrback(lambda failure: failure.trap(EntangledError))

    async def resolve(self, posted: Posted, bidder: bytes, value: bytes | None, counter: int = 0) -> bytes | None:
        """See a decree through, whatever it takes, and return what was decided.

        ``value`` is proposed where nothing else was; with None nothing is, and None is returned where nothing was
        accepted.  Ends only when the council has decided; raises ``NotRunning`` when the claimant itself is stopped.
        """
        pause = BACK_OFF[0]
        while True:
            counter += 1
            ballot = Ballot(counter, bidder)
            [claimed] = await self.claim([posted], ballot, RESOLVE_LEASE)
            counter = max(counter, claimed.counter)
            outcome = claimed
            if claimed.result is Result.WON:
                chosen = claimed.value or value
                if chosen is None:
                    self.release([posted], ballot)
                    return None
                [outcome] = await self.confirm([posted], ballot, chosen)
                counter = max(counter, outcome.counter)
                if outcome.result is Result.WON:
                    return chosen
            if outcome.result is Result.DECIDED:
                return outcome.value
            if self._chores.is_stopped:
                raise NotRunning("the tuple space was stopped while a take was being confirmed")
            # Not for the whole of another's lease: it may end sooner, or with a decision.
            await self._chores.sleep(max(min(outcome.remaining, BACK_OFF[1]), pause * (0.5 + self._rng.random())))
            pause = min(2 * pause, BACK_OFF[1])

    async def _round(
        self, posted: Sequence[Posted], method: str, wanted: Kind, ballot: Ballot, last: object
    ) -> list[Outcome]:
        council = posted[0].council
        tallies = [Tally(len(council), wanted) for _ in posted]
        done: Deferred[None] = Deferred()

        def settle() -> None:
            if not done.called and all(tally.outcome is not None for tally in tallies):
                done.callback(None)

        def answered(answer: object) -> None:
            replies = answer if isinstance(answer, list) and len(answer) == len(posted) else [None] * len(posted)
            for tally, fields in zip(tallies, replies, strict=True):
                tally.add(reply_unpacked(fields))
            settle()

        def lost(failure: Any) -> None:
            for tally in tallies:
                tally.add(None)
            settle()
            failure.trap(EntangledError)

        for member in council:
            asked = self._ask(member.contact, method, (*_arguments(posted, member, ballot), last))
            asked.addCallbacks(answered, lost)
        await done
        return [tally.outcome or Outcome(Result.SILENT) for tally in tallies]


def _arguments(posted: Sequence[Posted], member: Member, ballot: Ballot) -> tuple[object, ...]:
    places = [one.place.packed() for one in posted]
    return (posted[0].place.key, places, member.incarnation, ballot.counter, ballot.taker)
