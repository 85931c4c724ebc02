"""The requests of a proposer to the council of a task, the nodes whose majority grants its lease.

The task's record names the council with a number, its configuration.  Only a majority of the present council can change
it, and only while no lease is valid (consensus rules 1 and 2).  The ``charter`` has the signatures of that majority; a
claim of a single member about another council is ignored.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Sequence
from typing import Any

from twisted.internet.defer import Deferred, DeferredList
from twisted.internet.interfaces import IReactorTime

from middleware.consensus.lease.charter import Charter, Ending, is_change_signed, is_end_signed
from middleware.consensus.lease.lease_codec import LIFE, MAX_COUNCIL, pack_members, unpack_reply
from middleware.entangled.contact import Contact
from middleware.entangled.errors import Refused
from middleware.entangled.quorum.ballot import FIRST, Ballot, believed, majority
from middleware.entangled.quorum.register import Kind, Reply
from middleware.entangled.quorum.round import PAUSE, Round, Tally

Ask = Callable[[Contact, str, tuple[Any, ...]], Deferred[Any]]
"""Calls a method of a council member: (member, method, arguments)."""
IsGenuine = Callable[[int, Reply], bool]
Read = Callable[[str, object], Charter | None]
"""Decodes and checks a charter: (task id, packed)."""
LEAP = 16
"""Counters to skip: more than a holder uses before a standby asks again."""


class OpenClaim(Refused):
    """The council cannot change while an agent holds a lease."""


class Superseded(Refused):
    """Another change of the council was decided; ``Council`` has the present one."""


class NoMajority(Refused):
    """Too few members of the council agreed, or another proposer was faster; try again."""


class Council:
    """The council of one task as the proposer ``agent`` knows it.

    ``moved`` is called after a change of the council, to update the task's record.  ``token`` is the highest known
    token; new claims are above it.  ``charter`` proves the council, ``read`` decodes and checks charters from members,
    and ``ending`` is the proof that the task was closed under a token.
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
        charter: Charter | None = None,
        read: Read = lambda task_id, packed: None,
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
        self.charter = charter
        self.ending = b""
        self.moved = moved
        self._read = read
        self._ask = ask
        self._clock = clock
        self._rounds = 0
        self._life = rng.randrange(LIFE)
        self._last_round: tuple[Round, tuple[Contact, ...]] | None = None
        self._silent_since: dict[bytes, float] = {}

    def next_ballot(self) -> Ballot:
        """Return a ballot above all known ones."""
        self._rounds += 1
        return Ballot(self._rounds * LIFE + self._life, self.agent)

    def leap(self) -> None:
        """Raise the next ballot above unknown ballots of other proposers."""
        self._rounds += LEAP

    def round(
        self,
        method: str,
        *arguments: Any,
        kinds: tuple[Kind, ...] = (Kind.GRANTED,),
        short: float = PAUSE,
        is_genuine: IsGenuine = lambda place, reply: True,
        others: tuple[Contact, ...] = (),
    ) -> Round:
        """Start a round with all members, or with ``others``; pass its outcome to ``hear``.

        If another agent's lease at a member ends within ``short`` seconds, the round repeats the request then.
        """
        members = others or self.members
        request = (self.task_id, *arguments) if others else (self.task_id, self.configuration, *arguments)

        def ask(place: int) -> Deferred[Any]:
            return self._ask(members[place], method, request)

        def decode(place: int, answer: object) -> list[Reply] | None:
            reply = unpack_reply(answer)
            return None if reply is None or not is_genuine(place, reply) else [reply]

        if not others:
            self._update_silence()
        round_ = Round([Tally(len(members), kinds)], ask, decode, self._clock, self.ttl / 3, short)
        if not others:
            self._last_round = round_, members
        return round_

    def visit(self) -> None:
        """Ping the members, to update ``silent``."""
        self.round("lease.prepare", 0, self.ttl)

    def silent(self, seconds: float) -> tuple[Contact, ...]:
        """Return the members that have not answered any request for ``seconds``."""
        self._update_silence()
        latest = self._clock.seconds() - seconds
        return tuple(m for m in self.members if self._silent_since.get(m.node_id, math.inf) <= latest)

    def learn(self, packed: bytes) -> None:
        """Adopt the charter in a record of the task, if it is valid and newer."""
        charter = self._read(self.task_id, packed)
        if charter is not None:
            self._adopt(charter, is_news=False)

    def note_token(self, token: int) -> None:
        """Note a token reported by a single node, which may have invented it."""
        self.token = max(self.token, believed([token], len(self.members)))

    def hear(self, round_: Round) -> None:
        """Learn used counters and tokens, and changes of the council, from the replies of a round."""
        replies, size = round_.tally.replies.values(), len(self.members)
        self._rounds = max(self._rounds, believed((reply.promised.counter // LIFE for reply in replies), size))
        self.token = max(self.token, believed((reply.token for reply in replies), size))
        charters = [self._read(self.task_id, reply.proof) for reply in replies if reply.kind is Kind.MOVED]
        newest = max(
            (each for each in charters if each is not None), key=lambda charter: charter.configuration, default=None
        )
        if newest is not None and newest.configuration > self.configuration:
            self._adopt(newest)
            return
        # Send the charter to members that missed the choice of this council.
        for place, reply in round_.tally.replies.items():
            if reply.kind is Kind.BEHIND and reply.configuration < self.configuration:
                self._install(self.members[place])

    def let_go(self, ballot: Ballot, heirs: Sequence[Contact] = (), rest: float = 0.0) -> Deferred[Any]:
        """Release promises and leases under ``ballot``, and notify the standbys ``heirs``.

        The robot may move for up to ``rest`` more seconds.  Fires when every member has answered or failed.
        """
        calls = [self._ask(member, "lease.release", (self.task_id, ballot.counter, rest)) for member in self.members]
        calls += [self._ask(heir, "lease.freed", (self.task_id, self.token, rest)) for heir in heirs]
        return DeferredList(calls, consumeErrors=True)

    def close(self, token: int = 0) -> Deferred[None]:
        """Close the task at its council, so that no more leases are granted; fires when no agent can act on it.

        ``token`` is the token of the agent that finished the task (its device is at rest), or 0 for a node whose role
        allows orders.  Fails with ``NoMajority``, or with ``Superseded`` if a higher token was granted.
        """
        return Deferred.fromCoroutine(self._close(token))

    def change(self, members: Sequence[Contact], keep: bool = False) -> Deferred[None]:
        """Change the council to ``members``; fires when a majority of them has installed it.

        With ``keep`` the own lease is released (``Lessee.move``) and reserved for this agent for one ttl.  Fails with
        ``OpenClaim`` while another agent holds a lease, ``NoMajority`` if the old council cannot decide, and
        ``Superseded`` if another change was in progress, which is then completed instead.
        """
        wanted = tuple(members)
        if not 0 < len(wanted) <= MAX_COUNCIL:
            raise ValueError(f"a council has 1 to {MAX_COUNCIL} members, not {len(wanted)}")
        return Deferred.fromCoroutine(self._change(wanted, keep))

    async def finish(self, ballot: Ballot, prepared: Round, keep: bool = True) -> None:
        """Complete a change that a member has accepted, because it may be decided already."""
        await self._decide(ballot, prepared.tally.to_complete, keep)

    # -- inside -----------------------------------------------------------------------------------------------------

    def _update_silence(self) -> None:
        """Update the times of silence from the answers to the last round."""
        if self._last_round is not None:
            round_, members = self._last_round
            for place in round_.answered:
                self._silent_since.pop(members[place].node_id, None)
            for place in round_.silent:
                self._silent_since.setdefault(members[place].node_id, round_.began_at)

    async def _close(self, token: int) -> None:
        closed_at = 0.0
        arguments = ("lease.close", token) if token else ("lease.cancel",)
        ended = (Kind.OVER, Kind.SEALED)
        while True:
            configuration, members = self.configuration, self.members

            def is_genuine(place: int, reply: Reply) -> bool:
                signed = self.task_id, configuration, self.agent, token, reply.proof  # noqa: B023
                return not token or reply.kind not in ended or is_end_signed(members[place], *signed)  # noqa: B023

            done = await self.round(*arguments, kinds=ended, is_genuine=is_genuine).outcome
            self.hear(done)
            closed_at = max(closed_at, self._lease_ends_at(done))
            if self.configuration != configuration:
                done.close()
                continue  # the council has changed meanwhile
            sealed = [reply for reply in done.tally.replies.values() if reply.kind is Kind.SEALED]
            if done.tally.is_won and sealed and len(done.tally.agreed) - len(sealed) < majority(len(self.members)):
                # Some accepted a change, which may be decided: the next council has to close as well.
                if token:
                    raise NoMajority("the end of the task is not recorded: its council is changing; try again")
                others = done.tally.to_complete
                done = await self.round("lease.cancel", configuration + 1, kinds=ended, others=others).outcome
                closed_at = max(closed_at, self._lease_ends_at(done))
            if not done.tally.is_won:
                done.close()
                if any(reply.kind is Kind.OUTBID for reply in done.tally.replies.values()):
                    raise Superseded("the end of the task is not recorded: a higher token was granted")
                _raise(done, "the end of the task is not recorded")
            break
        if token and self.charter is not None:
            votes = [
                (place, reply.proof) for place, reply in sorted(done.tally.replies.items()) if reply.kind is Kind.OVER
            ]
            self.ending = Ending(self.charter, tuple(votes[: majority(len(self.members))])).packed
        rest = closed_at - self._clock.seconds()
        if rest > 0.0:
            pause: Deferred[None] = Deferred()
            self._clock.callLater(rest, pause.callback, None)
            await pause

    def _lease_ends_at(self, done: Round) -> float:
        """Return the end of a lease that may be valid: any closing majority has a member that granted it."""
        return self._clock.seconds() + max(
            (done.tally.replies[place].remaining for place in done.tally.agreed), default=0.0
        )

    async def _change(self, wanted: tuple[Contact, ...], keep: bool) -> None:
        before = self.configuration
        ballot = self.next_ballot()
        round_ = self.round("lease.prepare", ballot.counter, self.ttl, kinds=(Kind.GRANTED, Kind.SEALED))
        prepared = await round_.outcome
        prepared.close()
        self.hear(prepared)
        if self.configuration != before:
            raise Superseded(f"the council is at configuration {self.configuration} already; check it and try again")
        if not prepared.tally.is_won:
            _raise(prepared, "the council is unchanged")
        if prepared.tally.to_complete is not None:
            await self.finish(ballot, prepared, keep)
        else:
            await self._decide(ballot, wanted, keep)
        if self.configuration == before + 1 and set(self.members) != set(wanted):
            raise Superseded("another change of the council was in progress and is complete now; check it")

    async def _decide(self, ballot: Ballot, members: tuple[Contact, ...], keep: bool) -> None:
        """Have a majority of the old council accept ``members``, then a majority of ``members`` install them."""
        # The council may change during the awaits below; this decision belongs to the present one.
        old, before = self.members, self.charter
        if before is None or before.configuration != self.configuration:
            raise Refused("the council of this task was not signed when it was published; submit the task again")
        accepted = await self._decision(ballot, members, keep)
        accepted.close()
        if not accepted.tally.is_won:
            self.hear(accepted)
            self.let_go(ballot, rest=self.ttl)  # a lease of this agent stays valid
            _raise(accepted, "the council is unchanged")
        votes = [
            (place, accepted.tally.replies[place]) for place in sorted(accepted.tally.agreed)[: majority(len(old))]
        ]
        charter = before.extended(members, ballot, tuple((place, reply.token, reply.proof) for place, reply in votes))
        arguments, kinds = (charter.packed, keep, self.ttl), (Kind.GRANTED, Kind.MOVED)
        installed = await self.round("lease.install", *arguments, kinds=kinds, others=members).outcome
        if not installed.tally.is_won:
            raise NoMajority("the new council is decided, but too few of its members have it; request the change again")
        self._adopt(charter)
        for member in old:
            # Former members can then refer proposers to the new council.
            if member not in members:
                self._install(member, charter)

    async def _decision(self, ballot: Ballot, members: tuple[Contact, ...], keep: bool) -> Round:
        """Run the deciding round: a majority of the *old* council excludes open leases and other changes."""
        old, configuration = self.members, self.configuration

        def is_genuine(place: int, reply: Reply) -> bool:
            change = self.task_id, configuration, ballot, members, reply
            return reply.kind is not Kind.GRANTED or is_change_signed(old[place], *change)

        arguments = ballot.counter, pack_members(members), self.token, keep
        return await self.round("lease.change", *arguments, is_genuine=is_genuine).outcome

    def _install(self, member: Contact, charter: Charter | None = None) -> None:
        """Send ``member`` the charter of the present council."""
        charter = charter or self.charter
        if charter is not None and charter.links:
            update = (self.task_id, charter.packed, False, self.ttl)
            self._ask(member, "lease.install", update).addErrback(lambda _: None)

    def _adopt(self, charter: Charter, is_news: bool = True) -> None:
        if charter.configuration > self.configuration:
            self.charter, self.configuration, self.members = charter, charter.configuration, charter.members
            if is_news:
                self.moved()


def _raise(round_: Round, what: str) -> None:
    """Raise the exception for a round without a majority."""
    replies: list[Reply] = list(round_.tally.replies.values())
    held = [reply.remaining for reply in replies if reply.kind is Kind.HELD]
    if held:
        raise OpenClaim(f"{what}: an agent holds the lease, which expires in {max(held):.2f} s unless renewed")
    if any(reply.kind is Kind.OUTBID for reply in replies):
        raise NoMajority(f"{what}: another proposer was faster; try again")
    if any(reply.kind is Kind.OVER for reply in replies) and Kind.OVER not in round_.tally.kinds:
        raise Refused(f"{what}: the task has ended")
    raise NoMajority(f"{what}: too few of the {len(replies)} members that answered agreed; try again")
