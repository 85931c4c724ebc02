"""Council: the nodes whose majority says who may act on a task, as a claimant knows them; pinned, never "the closest".

Which nodes these are stands in the task's record with a number, its configuration.  A change is decided by a majority
of the old council and by nobody else, never while a claim is open (consensus rules 1 and 2).  The signatures of that
majority are kept in the ``charter``; what a single member says of another council is not believed.
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
"""Ask a council member: (member, method, arguments)."""
IsGenuine = Callable[[int, Reply], bool]
Read = Callable[[str, object], Charter | None]
"""Makes a charter of what a member sent, where it holds: (task id, packed)."""
LEAP = 16
"""More ballots than a holder needs until a stand-by looks."""


class OpenClaim(Refused):
    """The council cannot change: an agent holds a lease of it."""


class Superseded(Refused):
    """Another council was chosen than the one that was asked for; the present one is known now."""


class NoMajority(Refused):
    """Too few members of the council answered, or another proposer was faster; try again."""


class Council:
    """The council of one task, in the name of ``agent``.

    ``moved`` is called when it has become another one, so that the task's record can say so.  ``token`` is the highest
    that was ever seen: whatever is claimed next lies above it.  ``charter`` proves which council it is, ``read`` makes
    one of what a member sent, and ``ending`` is the proof that the task was closed under a token.
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
        """A ballot above all that were seen."""
        self._rounds += 1
        return Ballot(self._rounds * LIFE + self._life, self.agent)

    def leap(self) -> None:
        """Have the next ballot be above those of which nobody has told here; there are more than enough."""
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
        """Ask every member, or ``others``; tell ``hear`` what came of it.

        ``short`` is the wait for another's lease that is one.
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
        asked = Round([Tally(len(members), kinds)], ask, decode, self._clock, self.ttl / 3, short)
        if not others:
            self._last = asked, members
        return asked

    def visit(self) -> None:
        """Ask the members for nothing but whether they are there; ``silent`` knows it later."""
        self.round("lease.prepare", 0, self.ttl)

    def silent(self, seconds: float) -> tuple[Contact, ...]:
        """The members that have answered nothing for so long, in spite of questions."""
        self._note_silence()
        latest = self._clock.seconds() - seconds
        return tuple(m for m in self.members if self._silent_since.get(m.node_id, math.inf) <= latest)

    def learn(self, packed: bytes) -> None:
        """A record of the task has the charter of a council; what is older, or does not hold, changes nothing."""
        charter = self._read(self.task_id, packed)
        if charter is not None:
            self._adopt(charter, is_news=False)

    def note_token(self, token: int) -> None:
        """Some node says that ``token`` was granted; it may have invented it."""
        self.token = max(self.token, believed([token], len(self.members)))

    def hear(self, round_: Round) -> None:
        """Learn from answers which numbers are taken, and whether the council is another one now."""
        replies, size = round_.tally.replies.values(), len(self.members)
        self._rounds = max(self._rounds, believed((reply.promised.counter // LIFE for reply in replies), size))
        self.token = max(self.token, believed((reply.token for reply in replies), size))
        told = [self._read(self.task_id, reply.proof) for reply in replies if reply.kind is Kind.MOVED]
        newest = max(
            (each for each in told if each is not None), key=lambda charter: charter.configuration, default=None
        )
        if newest is not None and newest.configuration > self.configuration:
            self._adopt(newest)
            return
        # Who was away when this council was chosen is told by whoever meets it.
        for place, reply in round_.tally.replies.items():
            if reply.kind is Kind.BEHIND and reply.configuration < self.configuration:
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

        ``token`` is that of the lease under which it was done (the device stands still by now), 0 the word of a node
        that may order.  Fails with ``NoMajority``, or with ``Superseded`` where a higher token was granted.
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
        await self._decide(ballot, prepared.tally.to_complete, keep)

    # -- inside -----------------------------------------------------------------------------------------------------

    def _note_silence(self) -> None:
        """Who did not answer the last round, though it was asked often enough; who did is there."""
        if self._last is not None:
            asked, members = self._last
            for place in asked.answered:
                self._silent_since.pop(members[place].node_id, None)
            for place in asked.silent:
                self._silent_since.setdefault(members[place].node_id, asked.began_at)

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
            over_at = max(over_at, self._over_at(done))
            if self.configuration != configuration:
                done.close()
                continue  # there is another council by now
            sealed = [reply for reply in done.tally.replies.values() if reply.kind is Kind.SEALED]
            if done.tally.is_won and sealed and len(done.tally.agreed) - len(sealed) < majority(len(self.members)):
                # A change was accepted by some: it may be decided, so the council to come has to know as well.
                if token:
                    raise NoMajority("the end of the task is not recorded: its council is changing; try again")
                others = done.tally.to_complete
                done = await self.round("lease.cancel", configuration + 1, kinds=ended, others=others).outcome
                over_at = max(over_at, self._over_at(done))
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
        rest = over_at - self._clock.seconds()
        if rest > 0.0:
            waited: Deferred[None] = Deferred()
            self._clock.callLater(rest, waited.callback, None)
            await waited

    def _over_at(self, done: Round) -> float:
        """When a lease ends that may be in force: a member that granted it is among any majority that closed."""
        return self._clock.seconds() + max(
            (done.tally.replies[place].remaining for place in done.tally.agreed), default=0.0
        )

    async def _change(self, wanted: tuple[Contact, ...], keep: bool) -> None:
        before = self.configuration
        ballot = self.next_ballot()
        asked = self.round("lease.prepare", ballot.counter, self.ttl, kinds=(Kind.GRANTED, Kind.SEALED))
        prepared = await asked.outcome
        prepared.close()
        self.hear(prepared)
        if self.configuration != before:
            raise Superseded(f"the council is at configuration {self.configuration} already; look at it again")
        if not prepared.tally.is_won:
            _raise(prepared, "the council stays as it is")
        if prepared.tally.to_complete is not None:
            await self.finish(ballot, prepared, keep)
        else:
            await self._decide(ballot, wanted, keep)
        if self.configuration == before + 1 and set(self.members) != set(wanted):
            raise Superseded("another change of the council was under way and is complete now; look at it again")

    async def _decide(self, ballot: Ballot, members: tuple[Contact, ...], keep: bool) -> None:
        """Let a majority of the old council accept ``members``, then tell these; a majority of them must know."""
        # The council of this object may become another one while answers are awaited; this decision is of this one.
        old, before = self.members, self.charter
        if before is None or before.configuration != self.configuration:
            raise Refused("the council of this task was not signed when it was published; make the task anew")
        accepted = await self._decision(ballot, members, keep)
        accepted.close()
        if not accepted.tally.is_won:
            self.hear(accepted)
            self.let_go(ballot, rest=self.ttl)  # a lease that this agent holds goes on
            _raise(accepted, "the council stays as it is")
        votes = [
            (place, accepted.tally.replies[place]) for place in sorted(accepted.tally.agreed)[: majority(len(old))]
        ]
        charter = before.extended(members, ballot, tuple((place, reply.token, reply.proof) for place, reply in votes))
        question, kinds = (charter.packed, keep, self.ttl), (Kind.GRANTED, Kind.MOVED)
        installed = await self.round("lease.install", *question, kinds=kinds, others=members).outcome
        if not installed.tally.is_won:
            raise NoMajority("the new council is chosen, but too few of its members know; ask for the change again")
        self._adopt(charter)
        for member in old:
            # So that who leaves can tell where the council is now.
            if member not in members:
                self._install(member, charter)

    async def _decision(self, ballot: Ballot, members: tuple[Contact, ...], keep: bool) -> Round:
        """A majority of the *old* council decides: so no lease of it can be open, nor another change be chosen."""
        old, configuration = self.members, self.configuration

        def is_genuine(place: int, reply: Reply) -> bool:
            change = self.task_id, configuration, ballot, members, reply
            return reply.kind is not Kind.GRANTED or is_change_signed(old[place], *change)

        question = ballot.counter, pack_members(members), self.token, keep
        return await self.round("lease.change", *question, is_genuine=is_genuine).outcome

    def _install(self, member: Contact, charter: Charter | None = None) -> None:
        """Tell ``member`` of the present council, which was chosen by the one before."""
        charter = charter or self.charter
        if charter is not None and charter.links:
            news = (self.task_id, charter.packed, False, self.ttl)
            self._ask(member, "lease.install", news).addErrback(lambda _: None)

    def _adopt(self, charter: Charter, is_news: bool = True) -> None:
        if charter.configuration > self.configuration:
            self.charter, self.configuration, self.members = charter, charter.configuration, charter.members
            if is_news:
                self.moved()


def _raise(round_: Round, what: str) -> None:
    """Say by name why a majority did not agree."""
    replies: list[Reply] = list(round_.tally.replies.values())
    held = [reply.remaining for reply in replies if reply.kind is Kind.HELD]
    if held:
        raise OpenClaim(f"{what}: a claim is open and runs out in {max(held):.2f} s unless it is renewed")
    if any(reply.kind is Kind.OUTBID for reply in replies):
        raise NoMajority(f"{what}: another claimant was faster; try again")
    if any(reply.kind is Kind.OVER for reply in replies) and Kind.OVER not in round_.tally.kinds:
        raise Refused(f"{what}: the task has ended")
    raise NoMajority(f"{what}: {len(replies)} members answered, too few of them with yes; try again")
