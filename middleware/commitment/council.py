"""Council: the nodes whose majority says who may act on a task, as a claimant knows them; pinned, never "the closest".

Which nodes these are stands in the task's record with a number, its configuration.  A change is decided by a majority
of the old council and by nobody else, never while a claim is open (consensus rules 1 and 2).
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Sequence
from typing import Any

from twisted.internet.defer import Deferred, DeferredList
from twisted.internet.interfaces import IReactorTime

from middleware.commitment.ballot import (
    BEHIND,
    FIRST,
    GRANTED,
    HELD,
    LIFE,
    MAX_COUNCIL,
    MOVED,
    OUTBID,
    OVER,
    SEALED,
    Ballot,
    NoMajority,
    OpenClaim,
    Reply,
    Superseded,
)
from middleware.commitment.round import PAUSE, Ask, Round
from middleware.entangled.errors import Refused
from middleware.entangled.kademlia.contact import Contact

LEAP = 16
"""More ballots than a holder needs until a stand-by looks."""


class Council:
    """The council of one task, in the name of ``agent``.

    ``moved`` is called when it has become another one, so that the task's record can say so.  ``token`` is the highest
    that was ever seen: whatever is claimed next lies above it.
    """

    def __init__(
        self,
        task_id: str,
        agent: str,
        ttl: float,
        members: Sequence[Contact],
        ask: Ask,
        clock: IReactorTime,
        rng: random.Random,
        configuration: int = FIRST,
        token: int = 0,
        moved: Callable[[], None] = lambda: None,
    ) -> None:
        self.task_id = task_id
        self.agent = agent
        self.ttl = ttl
        self.members = tuple(members)
        self.configuration = configuration
        self.token = token
        self.moved = moved
        self._ask = ask
        self._clock = clock
        self._rounds = 0
        self._life = rng.randrange(LIFE)
        self._last: Round | None = None
        self._silent_since: dict[bytes, float] = {}

    def next_ballot(self) -> Ballot:
        """A ballot above all that were seen."""
        self._rounds += 1
        return Ballot(self._rounds * LIFE + self._life, self.agent)

    def leap(self) -> None:
        """Have the next ballot be above those of which nobody has told here; there are more than enough."""
        self._rounds += LEAP

    def round(self, method: str, *arguments: Any, kinds: tuple[str, ...] = (GRANTED,), short: float = PAUSE) -> Round:
        """Ask every member; tell ``hear`` what came of it.  ``short`` is the wait for another's lease that is one."""
        self._note_silence()
        question = (self.task_id, self.configuration, *arguments)
        self._last = Round(self.members, self._ask, self._clock, method, question, kinds, self.ttl / 3, short)
        return self._last

    def visit(self) -> None:
        """Ask the members for nothing but whether they are there; ``silent`` knows it later."""
        self.round("lease.prepare", 0, self.ttl)

    def silent(self, seconds: float) -> tuple[Contact, ...]:
        """The members that have answered nothing for so long, in spite of questions."""
        self._note_silence()
        latest = self._clock.seconds() - seconds
        return tuple(m for m in self.members if self._silent_since.get(m.node_id, math.inf) <= latest)

    def learn(self, configuration: int, members: Sequence[Contact]) -> None:
        """The record of the task names the council of that configuration."""
        if configuration > self.configuration and members:
            self.configuration, self.members = configuration, tuple(members)

    def hear(self, round_: Round) -> None:
        """Learn from answers which numbers are taken, and whether the council is another one now."""
        for reply in round_.replies.values():
            self._rounds = max(self._rounds, reply.ballot.counter // LIFE)
            self.token = max(self.token, reply.token)
        newest = max(round_.replies.values(), key=lambda reply: reply.configuration, default=None)
        if newest is not None and newest.kind == MOVED and newest.members:
            self._adopt(newest.configuration, newest.members)
            return
        # Who was away when this council was chosen is told by whoever meets it.
        for place, reply in round_.replies.items():
            if reply.kind == BEHIND and newest is not None and newest.configuration == self.configuration:
                self._install(self.members[place])

    def let_go(self, ballot: Ballot, heirs: Sequence[Contact] = (), rest: float = 0.0) -> Deferred[Any]:
        """Give back whatever was promised or granted under ``ballot``, and tell ``heirs``.

        The robot moves for at most ``rest`` seconds from now on.  Fires when every member has been told, or does not
        answer.
        """
        told = [self._ask(member, "lease.release", (self.task_id, ballot.counter, rest)) for member in self.members]
        told += [self._ask(heir, "lease.freed", (self.task_id, self.token, rest)) for heir in heirs]
        return DeferredList(told, consumeErrors=True)

    def close(self, token: int = 0) -> Deferred[None]:
        """Have no more leases granted on the task, which has ended; fires when nobody can act on it any more.

        ``token`` is that of the lease under which it was done (the device stands still by now), 0 an operator's word.
        Fails with ``NoMajority``, or with ``Superseded`` where a higher token was granted.
        """
        return Deferred.fromCoroutine(self._close(token))

    def change(self, members: Sequence[Contact], keep: bool = False) -> Deferred[None]:
        """Have ``members`` be the council from now on; fires when a majority of them knows.

        With ``keep`` the own lease is given back with this (``Lessee.move``), and for a ttl granted to nobody else.
        Fails with ``OpenClaim`` while somebody holds a lease, ``NoMajority`` where the old council cannot decide, and
        ``Superseded`` where another change was under way, which is then completed instead.
        """
        wanted = tuple(members)
        if not 0 < len(wanted) <= MAX_COUNCIL:
            raise ValueError(f"a council has 1 to {MAX_COUNCIL} members, not {len(wanted)}")
        return Deferred.fromCoroutine(self._change(wanted, keep))

    async def finish(self, ballot: Ballot, prepared: Round, keep: bool = True) -> None:
        """Complete a change that a member has accepted: it may be decided already, so no other may follow."""
        sealed = [reply for reply in prepared.replies.values() if reply.kind == SEALED]
        await self._decide(ballot, max(sealed, key=lambda reply: reply.ballot).members, keep)

    # -- inside -----------------------------------------------------------------------------------------------------

    def _note_silence(self) -> None:
        """Who did not answer the last round, though it was asked often enough; who did is there."""
        if self._last is not None:
            for member in self._last.answered:
                self._silent_since.pop(member.node_id, None)
            for member in self._last.silent:
                self._silent_since.setdefault(member.node_id, self._last.began_at)

    async def _close(self, token: int) -> None:
        over_at = 0.0
        while True:
            configuration = self.configuration
            done = await self.round("lease.close", token, kinds=(OVER, SEALED)).outcome
            self.hear(done)
            if not done.is_won:
                done.close()
                if self.configuration == configuration:
                    _raise(done, "the end of the task is not recorded")
                continue  # there is another council by now
            # Among any majority that closed is a member that granted whatever lease is still in force.
            rest = max(done.replies[place].remaining for place in done.yes)
            over_at = max(over_at, self._clock.seconds() + rest)
            sealed = [reply for reply in done.replies.values() if reply.kind == SEALED]
            if self.configuration == configuration and not sealed:
                break
            if sealed and self.configuration == configuration:
                # A change was accepted by some: it may be decided, so the council to come has to know as well.
                self._adopt(configuration + 1, max(sealed, key=lambda reply: reply.ballot).members)
        rest = over_at - self._clock.seconds()
        if rest > 0.0:
            waited: Deferred[None] = Deferred()
            self._clock.callLater(rest, waited.callback, None)
            await waited

    async def _change(self, wanted: tuple[Contact, ...], keep: bool) -> None:
        before = self.configuration
        ballot = self.next_ballot()
        asked = self.round("lease.prepare", ballot.counter, self.ttl, kinds=(GRANTED, SEALED))
        prepared = await asked.outcome
        prepared.close()
        self.hear(prepared)
        if self.configuration != before:
            raise Superseded(f"the council is at configuration {self.configuration} already; look at it again")
        if not prepared.is_won:
            _raise(prepared, "the council stays as it is")
        if any(reply.kind == SEALED for reply in prepared.replies.values()):
            await self.finish(ballot, prepared, keep)
        else:
            await self._decide(ballot, wanted, keep)
        if self.configuration == before + 1 and set(self.members) != set(wanted):
            raise Superseded("another change of the council was under way and is complete now; look at it again")

    async def _decide(self, ballot: Ballot, members: tuple[Contact, ...], keep: bool) -> None:
        """Let a majority of the old council accept ``members``, then tell these; a majority of them must know."""
        # The council of this object may become another one while answers are awaited; this decision is of this one.
        old, following = self.members, self.configuration + 1
        packed = [member.packed() for member in members]
        accepted = await self._decision(ballot, packed, keep)
        accepted.close()
        if not accepted.is_won:
            self.hear(accepted)
            self.let_go(ballot, rest=self.ttl)  # a lease that this agent holds goes on
            _raise(accepted, "the council stays as it is")
        token = max(self.token, *(reply.token for reply in accepted.replies.values()))
        news = (self.task_id, following, packed, token)
        question = (*news, ballot.counter if keep else 0, self.ttl)
        told = Round(members, self._ask, self._clock, "lease.install", question, (GRANTED, MOVED), self.ttl / 3)
        installed = await told.outcome
        if not installed.is_won:
            raise NoMajority("the new council is chosen, but too few of its members know; ask for the change again")
        self._adopt(following, members)
        for member in old:
            # So that who leaves can tell where the council is now.
            if member not in members:
                self._ask(member, "lease.install", (*news, 0, self.ttl)).addErrback(lambda _: None)

    async def _decision(self, ballot: Ballot, packed: list[list[object]], keep: bool) -> Round:
        """A majority of the *old* council decides: so no lease of it can be open, nor another change be chosen."""
        return await self.round("lease.change", ballot.counter, packed, self.token, keep).outcome

    def _install(self, member: Contact) -> None:
        """Tell ``member`` of the present council, which was chosen by the one before."""
        packed = [one.packed() for one in self.members]
        news = (self.task_id, self.configuration, packed, self.token, 0, self.ttl)
        self._ask(member, "lease.install", news).addErrback(lambda _: None)

    def _adopt(self, configuration: int, members: tuple[Contact, ...]) -> None:
        if configuration > self.configuration:
            self.configuration, self.members = configuration, members
            self.moved()


def _raise(round_: Round, what: str) -> None:
    """Say by name why a majority did not agree."""
    replies: list[Reply] = list(round_.replies.values())
    held = [reply.remaining for reply in replies if reply.kind == HELD]
    if held:
        raise OpenClaim(f"{what}: a claim is open and runs out in {max(held):.2f} s unless it is renewed")
    if any(reply.kind == OUTBID for reply in replies):
        raise NoMajority(f"{what}: another claimant was faster; try again")
    if any(reply.kind == OVER for reply in replies) and OVER not in round_.kinds:
        raise Refused(f"{what}: the task has ended")
    raise NoMajority(f"{what}: {len(replies)} members answered, too few of them with yes; try again")
