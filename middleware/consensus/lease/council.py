"""The quorum members of a task, as a client of theirs sees them: they are fixed, not the nodes closest to a key.

The task's record has the members and the number of their configuration.  Only a majority of the current members can
change them, and never while a claim is open (consensus rules 1 and 2).  The signatures of that majority are in the
``charter``; the statement of a single member is not trusted.
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
"""Sends a request to a member: (member, method, arguments)."""
IsGenuine = Callable[[int, Reply], bool]
Read = Callable[[str, object], Charter | None]
"""Decodes and checks a charter from a member: (task id, packed); None if it is invalid."""
LEAP = 16
"""Number of ballots to skip; more than a holder needs between two polls of a standby."""


class OpenClaim(Refused):
    """The quorum members cannot change while an agent holds a lease."""


class Superseded(Refused):
    """A concurrent change or claim won; this object now knows the current members or token."""


class NoMajority(Refused):
    """Too few members agreed: they did not answer, or another proposer was faster.  Try again."""


class Council:
    """The quorum members of one task, as used by ``agent``.

    ``moved`` is called after a change of the members, so that the task's record can be updated.  ``token`` is the
    highest token seen; new claims are above it.  ``charter`` proves the members, ``read`` checks charters from members,
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
        self._last: tuple[Round, tuple[Contact, ...]] | None = None
        self._silent_since: dict[bytes, float] = {}

    def next_ballot(self) -> Ballot:
        """Return a ballot above all ballots seen."""
        self._rounds += 1
        return Ballot(self._rounds * LIFE + self._life, self.agent)

    def leap(self) -> None:
        """Skip ballots, so that the next one is above the ballots of other standbys."""
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
        """Send a request to all members, or to ``others``; pass the finished round to ``hear``.

        ``short`` is the longest remaining lease of another agent, in seconds, that the round waits for.
        """
        members = others or self.members
        question = (self.task_id, *arguments) if others else (self.task_id, self.configuration, *arguments)

        def ask(place: int) -> Deferred[Any]:
            return self._ask(members[place], method, question)

        def decode(place: int, answer: object) -> list[Reply] | None:
            reply = unpack_reply(answer)
            return None if reply is None or not is_genuine(place, reply) else [reply]

        if not others:
            self._note_silence()
        sent_round = Round([Tally(len(members), kinds)], ask, decode, self._clock, self.ttl / 3, short)
        if not others:
            self._last = sent_round, members
        return sent_round

    def visit(self) -> None:
        """Probe the members without a claim; see ``silent``."""
        self.round("lease.prepare", 0, self.ttl)

    def silent(self, seconds: float) -> tuple[Contact, ...]:
        """Return the members that have not answered any request for at least this time."""
        self._note_silence()
        latest = self._clock.seconds() - seconds
        return tuple(m for m in self.members if self._silent_since.get(m.node_id, math.inf) <= latest)

    def learn(self, packed: bytes) -> None:
        """Process the charter in a task's record; older and invalid ones are ignored."""
        charter = self._read(self.task_id, packed)
        if charter is not None:
            self._adopt(charter, is_news=False)

    def note_token(self, token: int) -> None:
        """Raise ``token`` to a token reported by one node, within the limit of a plausible value."""
        self.token = max(self.token, believed([token], len(self.members)))

    def hear(self, round_: Round) -> None:
        """Learn the taken ballots and tokens from the replies of a round, and a newer configuration."""
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
        # Members that missed the change to the current configuration are informed here.
        for place, reply in round_.tally.replies.items():
            if reply.kind is Kind.BEHIND and reply.configuration < self.configuration:
                self._install(self.members[place])

    def let_go(self, ballot: Ballot, standbys: Sequence[Contact] = (), rest: float = 0.0) -> Deferred[Any]:
        """Release all promises and grants under ``ballot``, and notify ``standbys``.

        ``rest`` is the longest time in seconds for which the robot may still move.  Fires when every member has
        answered or timed out.
        """
        requests = [self._ask(member, "lease.release", (self.task_id, ballot.counter, rest)) for member in self.members]
        requests += [self._ask(standby, "lease.freed", (self.task_id, self.token, rest)) for standby in standbys]
        return DeferredList(requests, consumeErrors=True)

    def close(self, token: int = 0) -> Deferred[None]:
        """Close the task, so that no more leases are granted; fires when no agent can act on it any longer.

        ``token`` is the token of the lease under which the task was done (the device has stopped), or 0 for a node that
        may cancel tasks.  Fails with ``NoMajority``, or with ``Superseded`` if a higher token was granted.
        """
        return Deferred.fromCoroutine(self._close(token))

    def change(self, members: Sequence[Contact], keep: bool = False) -> Deferred[None]:
        """Change the quorum members to ``members``; fires when a majority of the new members knows.

        With ``keep`` the own lease is released by the change (``Lessee.move``) and reserved for this agent for one TTL.
        Fails with ``OpenClaim`` while an agent holds a lease, ``NoMajority`` if too few old members agree, and
        ``Superseded`` if another change was under way, which is then completed instead.
        """
        wanted = tuple(members)
        if not 0 < len(wanted) <= MAX_COUNCIL:
            raise ValueError(f"a task has 1 to {MAX_COUNCIL} quorum members, not {len(wanted)}")
        return Deferred.fromCoroutine(self._change(wanted, keep))

    async def finish(self, ballot: Ballot, prepared: Round, keep: bool = True) -> None:
        """Complete a change that a member has accepted: it may be decided already, so no other may replace it."""
        await self._decide(ballot, prepared.tally.to_complete, keep)

    # -- inside -----------------------------------------------------------------------------------------------------

    def _note_silence(self) -> None:
        """Record the members that did and did not answer the last round."""
        if self._last is not None:
            sent_round, members = self._last
            for place in sent_round.answered:
                self._silent_since.pop(members[place].node_id, None)
            for place in sent_round.silent:
                self._silent_since.setdefault(members[place].node_id, sent_round.began_at)

    async def _close(self, token: int) -> None:
        over_at = 0.0
        question = ("lease.close", token) if token else ("lease.cancel",)
        ended = (Kind.OVER, Kind.SEALED)
        while True:
            configuration, members = self.configuration, self.members

            def is_genuine(place: int, reply: Reply) -> bool:
                signed = self.task_id, configuration, self.agent, token, reply.proof  # noqa: B023
                return not token or reply.kind not in ended or is_end_signed(members[place], *signed)  # noqa: B023

            done = await self.round(*question, kinds=ended, is_genuine=is_genuine).outcome
            self.hear(done)
            over_at = max(over_at, self._leases_end_at(done))
            if self.configuration != configuration:
                done.close()
                continue  # the configuration has changed meanwhile
            sealed = [reply for reply in done.tally.replies.values() if reply.kind is Kind.SEALED]
            if done.tally.is_won and sealed and len(done.tally.agreed) - len(sealed) < majority(len(self.members)):
                # Some members accepted a change, which may be decided, so the new members must agree as well.
                if token:
                    raise NoMajority("the end of the task is not recorded: its quorum members are changing; try again")
                others = done.tally.to_complete
                done = await self.round("lease.cancel", configuration + 1, kinds=ended, others=others).outcome
                over_at = max(over_at, self._leases_end_at(done))
            if not done.tally.is_won:
                done.close()
                if any(reply.kind is Kind.OUTBID for reply in done.tally.replies.values()):
                    raise Superseded("the end of the task is not recorded: a higher token was granted")
                _raise_rejection(done, "the end of the task is not recorded")
            break
        if token and self.charter is not None:
            votes = [
                (place, reply.proof) for place, reply in sorted(done.tally.replies.items()) if reply.kind is Kind.OVER
            ]
            self.ending = Ending(self.charter, tuple(votes[: majority(len(self.members))])).packed
        rest = over_at - self._clock.seconds()
        if rest > 0.0:
            waited: Deferred[None] = Deferred()
            self._clock.callLater(rest, waited.callback, None)
            await waited

    def _leases_end_at(self, done: Round) -> float:
        """Return the end of any lease that may be valid: every majority has a member that granted it."""
        return self._clock.seconds() + max(
            (done.tally.replies[place].remaining for place in done.tally.agreed), default=0.0
        )

    async def _change(self, wanted: tuple[Contact, ...], keep: bool) -> None:
        before = self.configuration
        ballot = self.next_ballot()
        sent_round = self.round("lease.prepare", ballot.counter, self.ttl, kinds=(Kind.GRANTED, Kind.SEALED))
        prepared = await sent_round.outcome
        prepared.close()
        self.hear(prepared)
        if self.configuration != before:
            raise Superseded(
                f"the quorum members are already at configuration {self.configuration}; check them and try again"
            )
        if not prepared.tally.is_won:
            _raise_rejection(prepared, "the quorum members are unchanged")
        if prepared.tally.to_complete is not None:
            await self.finish(ballot, prepared, keep)
        else:
            await self._decide(ballot, wanted, keep)
        if self.configuration == before + 1 and set(self.members) != set(wanted):
            raise Superseded("another change of the quorum members was under way and is now complete; try again")

    async def _decide(self, ballot: Ballot, members: tuple[Contact, ...], keep: bool) -> None:
        """Have a majority of the old members accept ``members``, and a majority of the new ones install the charter."""
        # The attributes may change while this coroutine waits; this decision is about the present configuration.
        old, before = self.members, self.charter
        if before is None or before.configuration != self.configuration:
            raise Refused(
                "the quorum members of this task were not signed when it was published; create the task again"
            )
        accepted = await self._accept_change(ballot, members, keep)
        accepted.close()
        if not accepted.tally.is_won:
            self.hear(accepted)
            self.let_go(ballot, rest=self.ttl)  # a lease that this agent holds continues
            _raise_rejection(accepted, "the quorum members are unchanged")
        votes = [
            (place, accepted.tally.replies[place]) for place in sorted(accepted.tally.agreed)[: majority(len(old))]
        ]
        charter = before.extended(members, ballot, tuple((place, reply.token, reply.proof) for place, reply in votes))
        question, kinds = (charter.packed, keep, self.ttl), (Kind.GRANTED, Kind.MOVED)
        installed = await self.round("lease.install", *question, kinds=kinds, others=members).outcome
        if not installed.tally.is_won:
            raise NoMajority("the new quorum members are chosen, but too few of them are informed; repeat the change")
        self._adopt(charter)
        for member in old:
            # Inform the departing members, so that they can redirect clients.
            if member not in members:
                self._install(member, charter)

    async def _accept_change(self, ballot: Ballot, members: tuple[Contact, ...], keep: bool) -> Round:
        """Have a majority of the old members accept the change.

        This ensures that none of their leases is open and that no other change wins.
        """
        old, configuration = self.members, self.configuration

        def is_genuine(place: int, reply: Reply) -> bool:
            change = self.task_id, configuration, ballot, members, reply
            return reply.kind is not Kind.GRANTED or is_change_signed(old[place], *change)

        question = ballot.counter, pack_members(members), self.token, keep
        return await self.round("lease.change", *question, is_genuine=is_genuine).outcome

    def _install(self, member: Contact, charter: Charter | None = None) -> None:
        """Inform ``member`` of the current configuration."""
        charter = charter or self.charter
        if charter is not None and charter.links:
            arguments = (self.task_id, charter.packed, False, self.ttl)
            self._ask(member, "lease.install", arguments).addErrback(lambda _: None)

    def _adopt(self, charter: Charter, is_news: bool = True) -> None:
        if charter.configuration > self.configuration:
            self.charter, self.configuration, self.members = charter, charter.configuration, charter.members
            if is_news:
                self.moved()


def _raise_rejection(round_: Round, what: str) -> None:
    """Raise the error that explains why there was no majority."""
    replies: list[Reply] = list(round_.tally.replies.values())
    lease_times = [reply.remaining for reply in replies if reply.kind is Kind.HELD]
    if lease_times:
        raise OpenClaim(
            f"{what}: an agent holds a lease, which expires in {max(lease_times):.2f} s unless it is renewed"
        )
    if any(reply.kind is Kind.OUTBID for reply in replies):
        raise NoMajority(f"{what}: another claimant was faster; try again")
    if any(reply.kind is Kind.OVER for reply in replies) and Kind.OVER not in round_.tally.kinds:
        raise Refused(f"{what}: the task has ended")
    raise NoMajority(f"{what}: {len(replies)} members answered, and too few of them agreed; try again")
