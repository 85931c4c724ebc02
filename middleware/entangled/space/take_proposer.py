"""The proposer's requests to the council of a tuple, whose members are listed in the tuple's record.

The proposer claims tuples, confirms takes, and completes unfinished decisions; it depends only on a function that sends
a request to a member.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Sequence
from typing import Any

from twisted.internet.defer import Deferred
from twisted.internet.interfaces import IReactorTime

from middleware.entangled.background import Background
from middleware.entangled.contact import Contact
from middleware.entangled.errors import EntangledError, NotRunning
from middleware.entangled.quorum.acceptor import Event
from middleware.entangled.quorum.ballot import Ballot
from middleware.entangled.quorum.proposer import Outcome, Result, conclude, decide
from middleware.entangled.quorum.register import Reply
from middleware.entangled.quorum.round import Round, Tally
from middleware.entangled.space.take_codec import unpack_reply
from middleware.entangled.space.tuple_record import Member, StoredTuple

RESOLVE_LEASE_S = 2.0

Ask = Callable[[Contact, str, tuple[object, ...]], "Deferred[Any]"]
"""Calls a method of a member: (contact, method, arguments)."""


class TakeProposer:
    """The requests of one claimant to councils; ``background`` stops when the claimant stops."""

    def __init__(self, ask: Ask, clock: IReactorTime, rng: random.Random, background: Background) -> None:
        self._ask = ask
        self._clock = clock
        self._rng = rng
        self._background = background

    async def claim(self, tuples: Sequence[StoredTuple], ballot: Ballot, lease: float) -> list[Outcome]:
        """Run one round of claims for tuples of one key and council; then release the tuples that were not won."""
        outcomes = await self.renew(tuples, ballot, lease)
        lost = [p for p, o in zip(tuples, outcomes, strict=True) if o.result not in (Result.WON, Result.DECIDED)]
        if lost:
            # Promises of only a minority must not delay other claimants.
            self.release(lost, ballot)
        return outcomes

    async def renew(self, tuples: Sequence[StoredTuple], ballot: Ballot, lease: float) -> list[Outcome]:
        """Run one round of claims under a ballot that has already won; if it fails, the current lease stays valid."""
        return await self._run_round(tuples, "decree.claim", Event.PREPARE, ballot, lease)

    async def confirm(self, tuples: Sequence[StoredTuple], ballot: Ballot, value: bytes) -> list[Outcome]:
        """Run one round that confirms takes of tuples of one key and council."""
        return await self._run_round(tuples, "decree.confirm", Event.ACCEPT, ballot, value)

    def release(self, tuples: Sequence[StoredTuple], ballot: Ballot) -> None:
        """Release the leases at all reachable members; at unreachable members the leases expire."""
        for member in tuples[0].council:
            request = self._ask(member.contact, "decree.release", _make_arguments(tuples, member, ballot))
            request.addErrback(lambda failure: failure.trap(EntangledError))

    async def resolve(self, stored: StoredTuple, bidder: bytes, value: bytes | None, counter: int = 0) -> bytes | None:
        """Retry until the council has decided about a tuple, and return the decided value.

        Proposes ``value`` if no other value was accepted.  If ``value`` is None, no new value is proposed, and the
        result is None if no value was accepted.  Raises ``NotRunning`` when the claimant is stopped.
        """

        async def prepare(ballot: Ballot) -> Outcome:
            return (await self.claim([stored], ballot, RESOLVE_LEASE_S))[0]

        async def accept(ballot: Ballot, chosen: bytes) -> Outcome:
            return (await self.confirm([stored], ballot, chosen))[0]

        async def sleep(seconds: float) -> None:
            if self._background.is_stopped:
                raise NotRunning("the tuple space stopped during the confirmation of a take")
            await self._background.sleep(seconds)

        ballot = Ballot(counter + 1, bidder)
        ballot, decided = await decide(ballot, value, prepare, accept, sleep, self._rng)
        if decided is None:
            self.release([stored], ballot)
        return decided  # type: ignore[no-any-return]

    async def _run_round(
        self, tuples: Sequence[StoredTuple], method: str, event: Event, ballot: Ballot, argument: object
    ) -> list[Outcome]:
        council = tuples[0].council

        def ask(index: int) -> Deferred[Any]:
            return self._ask(
                council[index].contact, method, (*_make_arguments(tuples, council[index], ballot), argument)
            )

        def decode(index: int, answer: object) -> list[Reply | None] | None:
            replies = answer if isinstance(answer, list) and len(answer) == len(tuples) else None
            return replies and [unpack_reply(fields, event) for fields in replies]

        tallies = [Tally(len(council)) for _ in tuples]
        await Round(tallies, ask, decode, self._clock, short=0.0, single=True).outcome
        return [conclude(tally) for tally in tallies]


def _make_arguments(tuples: Sequence[StoredTuple], member: Member, ballot: Ballot) -> tuple[object, ...]:
    packed_ids = [each.tuple_id.pack() for each in tuples]
    return (tuples[0].tuple_id.key, packed_ids, member.incarnation, ballot.counter, ballot.proposer)
