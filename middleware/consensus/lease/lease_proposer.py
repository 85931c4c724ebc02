"""The requests of a proposer to the council of a task, a majority of which grants the task's lease.

The task's record contains the members of the council and its configuration, a number that increases with each change.
Only a majority of the current council can change the council, and only when no lease is valid.  The ``charter``
contains the signatures of that majority, so a single member cannot make a proposer use a false council.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Sequence
from typing import Any

from twisted.internet.defer import Deferred, DeferredList
from twisted.internet.interfaces import IReactorTime

from middleware.consensus.lease.charter import Charter, EndProof, is_change_signed, is_end_signed
from middleware.consensus.lease.lease_codec import BALLOT_MODULUS, MAX_COUNCIL, pack_members, parse_reply
from middleware.entangled.contact import Contact
from middleware.entangled.errors import Refused
from middleware.entangled.quorum.ballot import FIRST_CONFIGURATION, Ballot, highest_credible, majority
from middleware.entangled.quorum.register import Reply, ReplyKind
from middleware.entangled.quorum.round import RETRY_INTERVAL_S, Round, Tally

Ask = Callable[[Contact, str, tuple[Any, ...]], Deferred[Any]]
"""Calls a method of a council member: (member, method, arguments)."""
IsGenuine = Callable[[int, Reply], bool]
ParseCharter = Callable[[str, object], Charter | None]
"""Decodes and checks a charter: (task id, packed)."""
SKIPPED_COUNTERS = 16
"""Number of ballot counters to skip: more than a holder uses between two polls of a standby."""


class LeaseHeld(Refused):
    """The council cannot change while an agent holds a lease."""


class Superseded(Refused):
    """A different change of the council was decided; ``LeaseProposer`` has the current council."""


class NoMajority(Refused):
    """Too few members of the council agreed, or another proposer was faster; try again."""


class LeaseProposer:
    """The council of one task, as known by the proposer ``agent``.

    ``on_change`` is called after a change of the council, to update the task's record.  ``token`` is the highest known
    token; new claims use higher tokens.  ``charter`` proves the members of the council, and ``parse_charter`` decodes
    and checks charters from members.  After ``close``, ``end_proof`` is the proof that the task was closed under a
    token.
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
        parse_charter: ParseCharter = lambda task_id, packed: None,
        configuration: int = FIRST_CONFIGURATION,
        token: int = 0,
        on_change: Callable[[], None] = lambda: None,
    ) -> None:
        self.task_id = task_id
        self.agent = agent
        self.ttl = ttl
        self.members = tuple(members)
        self.configuration = configuration
        self.token = token
        self.charter = charter
        self.end_proof = b""
        self.on_change = on_change
        self._parse_charter = parse_charter
        self._ask = ask
        self._clock = clock
        self._ballot_quotient = 0
        self._ballot_remainder = rng.randrange(BALLOT_MODULUS)
        self._last_round: tuple[Round, tuple[Contact, ...]] | None = None
        self._silent_since: dict[bytes, float] = {}

    def next_ballot(self) -> Ballot:
        """Return a ballot above all known ballots."""
        self._ballot_quotient += 1
        return Ballot(self._ballot_quotient * BALLOT_MODULUS + self._ballot_remainder, self.agent)

    def skip_ballots(self) -> None:
        """Raise the next ballot above ballots of other proposers that this client may not know yet."""
        self._ballot_quotient += SKIPPED_COUNTERS

    def start_round(
        self,
        method: str,
        *arguments: Any,
        kinds: tuple[ReplyKind, ...] = (ReplyKind.GRANTED,),
        short: float = RETRY_INTERVAL_S,
        is_genuine: IsGenuine = lambda place, reply: True,
        others: tuple[Contact, ...] = (),
    ) -> Round:
        """Start a round with all members, or with ``others``; pass its outcome to ``learn_from``.

        If a member replies that the lease of another agent ends within ``short`` seconds, the round repeats the request
        to this member at that time.
        """
        members = others or self.members
        request = (self.task_id, *arguments) if others else (self.task_id, self.configuration, *arguments)

        def ask(place: int) -> Deferred[Any]:
            return self._ask(members[place], method, request)

        def decode(place: int, answer: object) -> list[Reply] | None:
            reply = parse_reply(answer)
            return None if reply is None or not is_genuine(place, reply) else [reply]

        if not others:
            self._update_silence()
        round_ = Round([Tally(len(members), kinds)], ask, decode, self._clock, self.ttl / 3, short)
        if not others:
            self._last_round = round_, members
        return round_

    def ping_members(self) -> None:
        """Send a request to the members, to update ``find_silent_members``."""
        self.start_round("lease.prepare", 0, self.ttl)

    def find_silent_members(self, seconds: float) -> tuple[Contact, ...]:
        """Return the members that have not answered any request for ``seconds``."""
        self._update_silence()
        latest = self._clock.seconds() - seconds
        return tuple(m for m in self.members if self._silent_since.get(m.node_id, math.inf) <= latest)

    def learn_charter(self, packed: bytes) -> None:
        """Adopt the charter in a record of the task, if it is valid and newer."""
        charter = self._parse_charter(self.task_id, packed)
        if charter is not None:
            self._adopt_charter(charter, is_news=False)

    def note_token(self, token: int) -> None:
        """Note a token that a single node reported; a token that is too high to be credible is ignored."""
        self.token = max(self.token, highest_credible([token], len(self.members)))

    def learn_from(self, round_: Round) -> None:
        """Learn from the replies of a round which counters and tokens were used, and how the council changed."""
        replies, size = round_.tally.replies.values(), len(self.members)
        self._ballot_quotient = max(
            self._ballot_quotient,
            highest_credible((reply.promised.counter // BALLOT_MODULUS for reply in replies), size),
        )
        self.token = max(self.token, highest_credible((reply.token for reply in replies), size))
        charters = [
            self._parse_charter(self.task_id, reply.proof) for reply in replies if reply.kind is ReplyKind.MOVED
        ]
        newest = max(
            (each for each in charters if each is not None), key=lambda charter: charter.configuration, default=None
        )
        if newest is not None and newest.configuration > self.configuration:
            self._adopt_charter(newest)
            return
        # Send the charter to members that do not know this council yet.
        for place, reply in round_.tally.replies.items():
            if reply.kind is ReplyKind.BEHIND and reply.configuration < self.configuration:
                self._install(self.members[place])

    def release(self, ballot: Ballot, heirs: Sequence[Contact] = (), rest: float = 0.0) -> Deferred[Any]:
        """Release promises and leases under ``ballot``, and notify the standbys ``heirs``.

        The robot may move for up to ``rest`` more seconds.  Fires when every member has answered or failed.
        """
        calls = [self._ask(member, "lease.release", (self.task_id, ballot.counter, rest)) for member in self.members]
        calls += [self._ask(heir, "lease.freed", (self.task_id, self.token, rest)) for heir in heirs]
        return DeferredList(calls, consumeErrors=True)

    def close(self, token: int = 0) -> Deferred[None]:
        """Close the task at its council, so that no more leases are granted; fire when no agent can act on the task.

        ``token`` is the token of the agent that finished the task, whose device must be at rest.  It is 0 if the caller
        is a node whose role allows it to give orders.  Fails with ``NoMajority``, or with ``Superseded`` if a higher
        token was granted.
        """
        return Deferred.fromCoroutine(self._close(token))

    def change_members(self, members: Sequence[Contact], keep: bool = False) -> Deferred[None]:
        """Change the council to ``members``; fire when a majority of ``members`` has installed the change.

        If ``keep``, the lease of this agent, which ``LeaseClient.change_council`` has released, is reserved for this
        agent for one ttl.  Fails with ``LeaseHeld`` if another agent holds the lease, with ``NoMajority`` if the old
        council cannot decide, and with ``Superseded`` if a different change was in progress, which is then completed
        instead.
        """
        wanted = tuple(members)
        if not 0 < len(wanted) <= MAX_COUNCIL:
            raise ValueError(f"a council must have 1 to {MAX_COUNCIL} members, not {len(wanted)}")
        return Deferred.fromCoroutine(self._change_members(wanted, keep))

    async def complete_change(self, ballot: Ballot, prepared: Round, keep: bool = True) -> None:
        """Complete a change that a member has accepted, because it may already be decided."""
        await self._decide(ballot, prepared.tally.value_to_complete, keep)

    # -- inside -----------------------------------------------------------------------------------------------------

    def _update_silence(self) -> None:
        """Update the time since which each member is silent from the replies of the last round."""
        if self._last_round is not None:
            round_, members = self._last_round
            for place in round_.answered_places:
                self._silent_since.pop(members[place].node_id, None)
            for place in round_.silent_places:
                self._silent_since.setdefault(members[place].node_id, round_.began_at)

    async def _close(self, token: int) -> None:
        closed_at = 0.0
        arguments = ("lease.close", token) if token else ("lease.cancel",)
        ended = (ReplyKind.OVER, ReplyKind.SEALED)
        while True:
            configuration, members = self.configuration, self.members

            def is_genuine(place: int, reply: Reply) -> bool:
                signed = self.task_id, configuration, self.agent, token, reply.proof  # noqa: B023
                return not token or reply.kind not in ended or is_end_signed(members[place], *signed)  # noqa: B023

            done = await self.start_round(*arguments, kinds=ended, is_genuine=is_genuine).outcome
            self.learn_from(done)
            closed_at = max(closed_at, self._estimate_lease_end(done))
            if self.configuration != configuration:
                done.close()
                continue  # the council has changed during the round
            sealed = [reply for reply in done.tally.replies.values() if reply.kind is ReplyKind.SEALED]
            if (
                done.tally.is_won
                and sealed
                and len(done.tally.agreeing_places) - len(sealed) < majority(len(self.members))
            ):
                # Some members accepted a change, which may be decided, so the next council also has to close the task.
                if token:
                    raise NoMajority("the end of the task is not recorded: the task's council is changing; try again")
                others = done.tally.value_to_complete
                done = await self.start_round("lease.cancel", configuration + 1, kinds=ended, others=others).outcome
                closed_at = max(closed_at, self._estimate_lease_end(done))
            if not done.tally.is_won:
                done.close()
                if any(reply.kind is ReplyKind.OUTBID for reply in done.tally.replies.values()):
                    raise Superseded("the end of the task is not recorded: a higher token was granted")
                _raise_no_majority(done, "the end of the task is not recorded")
            break
        if token and self.charter is not None:
            votes = [
                (place, reply.proof)
                for place, reply in sorted(done.tally.replies.items())
                if reply.kind is ReplyKind.OVER
            ]
            self.end_proof = EndProof(self.charter, tuple(votes[: majority(len(self.members))])).packed
        rest = closed_at - self._clock.seconds()
        if rest > 0.0:
            pause: Deferred[None] = Deferred()
            self._clock.callLater(rest, pause.callback, None)
            await pause

    def _estimate_lease_end(self, done: Round) -> float:
        """Return the latest end of a lease that may still be valid, according to the members that closed the task."""
        return self._clock.seconds() + max(
            (done.tally.replies[place].remaining for place in done.tally.agreeing_places), default=0.0
        )

    async def _change_members(self, wanted: tuple[Contact, ...], keep: bool) -> None:
        before = self.configuration
        ballot = self.next_ballot()
        round_ = self.start_round(
            "lease.prepare", ballot.counter, self.ttl, kinds=(ReplyKind.GRANTED, ReplyKind.SEALED)
        )
        prepared = await round_.outcome
        prepared.close()
        self.learn_from(prepared)
        if self.configuration != before:
            raise Superseded(f"the council has changed to configuration {self.configuration}; check it and try again")
        if not prepared.tally.is_won:
            _raise_no_majority(prepared, "the council is unchanged")
        if prepared.tally.value_to_complete is not None:
            await self.complete_change(ballot, prepared, keep)
        else:
            await self._decide(ballot, wanted, keep)
        if self.configuration == before + 1 and set(self.members) != set(wanted):
            raise Superseded("a different change was in progress and was completed instead; check the council")

    async def _decide(self, ballot: Ballot, members: tuple[Contact, ...], keep: bool) -> None:
        """Make a majority of the old council accept ``members``, then a majority of ``members`` install the change."""
        # Use this council even if ``self.members`` changes during one of the awaits below.
        old, before = self.members, self.charter
        if before is None or before.configuration != self.configuration:
            raise Refused("the council of this task was not signed when the task was published; submit the task again")
        accepted = await self._run_deciding_round(ballot, members, keep)
        accepted.close()
        if not accepted.tally.is_won:
            self.learn_from(accepted)
            self.release(ballot, rest=self.ttl)  # this does not release the lease of this agent
            _raise_no_majority(accepted, "the council is unchanged")
        votes = [
            (place, accepted.tally.replies[place])
            for place in sorted(accepted.tally.agreeing_places)[: majority(len(old))]
        ]
        charter = before.with_change(
            members, ballot, tuple((place, reply.token, reply.proof) for place, reply in votes)
        )
        arguments, kinds = (charter.packed, keep, self.ttl), (ReplyKind.GRANTED, ReplyKind.MOVED)
        installed = await self.start_round("lease.install", *arguments, kinds=kinds, others=members).outcome
        if not installed.tally.is_won:
            raise NoMajority("the new council is decided, but not installed by a majority of it; repeat the change")
        self._adopt_charter(charter)
        for member in old:
            # A former member that knows the new council can send its charter to proposers.
            if member not in members:
                self._install(member, charter)

    async def _run_deciding_round(self, ballot: Ballot, members: tuple[Contact, ...], keep: bool) -> Round:
        """Run the deciding round, in which a majority of the *old* council excludes valid leases and other changes."""
        old, configuration = self.members, self.configuration

        def is_genuine(place: int, reply: Reply) -> bool:
            change = self.task_id, configuration, ballot, members, reply
            return reply.kind is not ReplyKind.GRANTED or is_change_signed(old[place], *change)

        arguments = ballot.counter, pack_members(members), self.token, keep
        return await self.start_round("lease.change", *arguments, is_genuine=is_genuine).outcome

    def _install(self, member: Contact, charter: Charter | None = None) -> None:
        """Send the charter of the current council to ``member``."""
        charter = charter or self.charter
        if charter is not None and charter.changes:
            update = (self.task_id, charter.packed, False, self.ttl)
            self._ask(member, "lease.install", update).addErrback(lambda _: None)

    def _adopt_charter(self, charter: Charter, is_news: bool = True) -> None:
        if charter.configuration > self.configuration:
            self.charter, self.configuration, self.members = charter, charter.configuration, charter.members
            if is_news:
                self.on_change()


def _raise_no_majority(round_: Round, what: str) -> None:
    """Raise the exception that describes why a round has no majority."""
    replies: list[Reply] = list(round_.tally.replies.values())
    held = [reply.remaining for reply in replies if reply.kind is ReplyKind.HELD]
    if held:
        raise LeaseHeld(f"{what}: an agent holds the lease, which expires in {max(held):.2f} s unless renewed")
    if any(reply.kind is ReplyKind.OUTBID for reply in replies):
        raise NoMajority(f"{what}: another proposer was faster; try again")
    if any(reply.kind is ReplyKind.OVER for reply in replies) and ReplyKind.OVER not in round_.tally.kinds:
        raise Refused(f"{what}: the task has ended")
    raise NoMajority(f"{what}: too few of the {len(replies)} members that answered agreed; try again")
