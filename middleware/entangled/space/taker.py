"""Taker: claims and takes tuples for a space, and completes what others began and left undone."""

from __future__ import annotations

import random
import zlib
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

from twisted.internet.defer import Deferred, FirstError, fail, gatherResults, maybeDeferred
from twisted.internet.interfaces import IReactorTime

from middleware.entangled.background import Background, first
from middleware.entangled.contact import Contact
from middleware.entangled.errors import EntangledError, NoAnswer, Refused
from middleware.entangled.kademlia.distance import closest
from middleware.entangled.listeners import Listeners
from middleware.entangled.quorum.ballot import Ballot
from middleware.entangled.quorum.proposer import Outcome, Result
from middleware.entangled.space.council import Council
from middleware.entangled.space.keeper import Keeper
from middleware.entangled.space.peer import Peer
from middleware.entangled.space.posting import INCARNATION_BYTES, Member, Place, Posted, standing
from middleware.entangled.space.seat import MAX_PLACES
from middleware.entangled.space.template import Template, Tuple

MARGIN = 0.02
"""Share by which two clocks of correct nodes may drift apart (1 % each)."""
ENROLLED = 5.0
"""Seconds for which the council of a key is not asked again whether it is there."""
ENROLMENTS = 3
"""Times that the nodes closest to a key are looked up and asked until a council is whole."""
REPAIR = 2.0
LEASED_RETRY = 0.5
CONTEST_RETRY = (0.02, 0.08)
SILENT_RETRY = (0.2, 0.6)
MAX_REMEMBERED = 10_000
OVER = "the claim was confirmed or released before"


class ClaimLost(Refused):
    """The tuple was taken by another; what was done about it must not count."""


class Wait:
    """One call that waits for a tuple; ``is_over`` when it was answered, cancelled or timed out."""

    def __init__(self) -> None:
        self.is_over = False
        self.deferred: Deferred[Any] = Deferred(lambda _: self.end())
        self.on_end = Listeners[[]]()

    def end(self) -> None:
        """Let whoever works for this call know that nobody waits any more."""
        if not self.is_over:
            self.is_over = True
            self.on_end()


@dataclass
class Claim:
    """The sole right to take a tuple, until ``deadline`` (seconds of the own clock); then others may claim it.

    Confirm it when the work is done.  Whoever does neither that nor renew loses it, which is how a tuple comes back
    from a taker that died.
    """

    posted: Posted
    ballot: Ballot
    lease: float
    deadline: float
    _taker: Taker = field(repr=False)
    is_over: bool = False

    @property
    def fields(self) -> Tuple:
        """The tuple."""
        return self.posted.fields

    def confirm(self) -> Deferred[Tuple]:
        """Take the tuple for good; fires when the council has decided.

        Fails with ``ClaimLost`` where it decided for another, which can happen only after the deadline.  Cancelled
        meanwhile, the tuple is put back should the council decide for us.
        """
        return fail(ClaimLost(OVER)) if self.is_over else self._taker.confirm(self)

    def release(self) -> None:
        """Give the tuple back at once."""
        if not self.is_over:
            self.is_over = True
            self._taker.release(self)

    def renew(self) -> Deferred[None]:
        """Hold the tuple for another lease from now; fails with ``ClaimLost``, or ``NoAnswer`` while time is left."""
        return fail(ClaimLost(OVER)) if self.is_over else Deferred.fromCoroutine(self._taker.renew(self))


class Taker:
    """The takes of one node in one space; ``held`` are the tuples it holds, ``gone`` those it knows to be taken.

    ``freed`` is called when this node gives up a tuple that it held or failed to claim, ``put_back`` with a tuple
    that was confirmed to a call for which nobody waits any more.
    """

    def __init__(
        self,
        node: Peer,
        clock: IReactorTime,
        rng: random.Random,
        chores: Background,
        keeper: Keeper,
        council: int,
        freed: Callable[[Place], None],
        put_back: Callable[[Tuple], object],
    ) -> None:
        self._freed = freed
        self._put_back = put_back
        self.held: set[Place] = set()
        self.gone: dict[Place, bytes] = {}
        self._node = node
        self._clock = clock
        self._rng = rng
        self._chores = chores
        self._keeper = keeper
        self._size = council
        self._council = Council(self._ask, clock, rng, chores)
        self._seed = zlib.crc32(node.identity.node_id)
        self._counters: dict[Place, int] = {}
        self._not_before: dict[Place, float] = {}
        self._members: dict[bytes, tuple[float, list[Member]]] = {}
        chores.every(REPAIR, self._repair)

    # -- councils ---------------------------------------------------------------------------------------------------

    async def enrolled(self, key: bytes) -> list[Member]:
        """The council for a tuple that is put now: the live nodes closest to ``key``, this one among them.

        It is smaller than it should be only where the network is; fails with ``NoAnswer`` where nodes that are there
        keep silent, for a council of two or one would not survive the loss of anybody.
        """
        until, members = self._members.get(key, (0.0, []))
        if until > self._clock.seconds():
            return members
        members = []
        for _ in range(ENROLMENTS):
            near = closest([*await self._node.find_node(key), self._node.contact], key, 2 * self._size)
            agreed = {member.contact.node_id for member in members}
            left, silent = [contact for contact in near if contact.node_id not in agreed], 0
            while left and len(members) < self._size:
                asked, left = left[: self._size - len(members)], left[self._size - len(members) :]
                answers = await first(len(asked), [self._enrol(contact) for contact in asked])
                members += [member for member in answers if member is not None]
                silent += len(asked) - len(answers)
            if members and (len(members) == self._size or not silent):
                self._members[key] = (self._clock.seconds() + ENROLLED, members)
                return members
        raise NoAnswer(f"{len(members)} of {self._size} nodes agree to be in the council of a tuple, others are silent")

    async def _enrol(self, contact: Contact) -> Member | None:
        """The node as a member, or None where it refuses."""
        try:
            incarnation = await self._ask(contact, "decree.enrol", ())
        except Refused:
            return None
        lawful = isinstance(incarnation, bytes) and len(incarnation) == INCARNATION_BYTES
        return Member(contact, incarnation) if lawful else None

    def _ask(self, contact: Contact, method: str, arguments: tuple[object, ...]) -> Deferred[Any]:
        node = self._node
        if contact.node_id == node.identity.node_id:
            answer = getattr(node.seat, method.replace("decree.", "answer_"))
            return maybeDeferred(answer, node.contact, *arguments)
        # A member may have moved since the tuple was put; its key is still the same.
        return node.endpoint.ask(node.newest(contact), method, *arguments, changes=method != "decree.enrol")

    # -- choosing ---------------------------------------------------------------------------------------------------

    def candidates(
        self, posted: Sequence[Posted], template: Template, is_patient: bool = True
    ) -> tuple[list[Posted], float | None]:
        """The tuples to try now, in this node's own order, and the seconds until another may be tried.

        Every node has another order, so that takers seldom fight for the same tuple.  What was missed comes after what
        was not tried, the longest ago first: else two tuples whose councils are gone would keep the rest from us.
        """
        now = self._clock.seconds()
        open_ = [p for p in posted if p.place not in self.gone and p.place not in self.held]
        fitting = [p for p in open_ if template.matches(p.fields)]
        ready = [p for p in fitting if not is_patient or self._not_before.get(p.place, 0.0) <= now]
        ready.sort(key=lambda p: (self._not_before.get(p.place, 0.0), zlib.crc32(p.place.mark, self._seed), p.place))
        moments = [self._not_before[p.place] for p in fitting if p.place in self._not_before]
        return ready, min((max(0.001, moment - now) for moment in moments), default=None)

    def batch(self, posted: Sequence[Posted], most: int) -> list[Posted]:
        """The first of ``posted`` and as many with the same council as fit into one question."""
        alike = [one for one in posted if one.council == posted[0].council]
        return alike[: min(most, MAX_PLACES)]

    # -- taking -----------------------------------------------------------------------------------------------------

    async def claim(self, posted: Sequence[Posted], lease: float) -> tuple[list[Claim], bool]:
        """Claim tuples of one council; what was won, and whether too little of the council was to be heard."""
        places = [one.place for one in posted]
        self.held.update(places)
        ballot = Ballot(1 + max(self._counters.get(place, 0) for place in places), self._bidder())
        sent = self._clock.seconds()
        outcomes = await self._council.claim(posted, ballot, lease)
        claims = []
        for one, outcome in zip(posted, outcomes, strict=True):
            self._counters[one.place] = max(ballot.counter, outcome.counter)
            if outcome.result is Result.WON and outcome.value is None:
                deadline = sent + lease * (1.0 - MARGIN)
                claims.append(Claim(one, ballot, lease, deadline, self))
                self._expire(claims[-1])
            elif outcome.result is Result.WON:
                # A taker died while it was confirming: what it began is completed in its name.
                self._chores.fork(self._complete(one, outcome.value))
            else:
                self._missed(one.place, outcome)
        _trim(self._counters)
        _trim(self._not_before)
        return claims, any(outcome.result is Result.SILENT for outcome in outcomes)

    async def decide(self, claims: Sequence[Claim], wait: Wait | None = None) -> list[bool]:
        """Confirm claims of one ballot and say of each whether the tuple is ours.

        Goes on until the council has decided, for nobody else may take meanwhile what it may have given to us; what
        is ours when nobody waits any more is put back.
        """
        if not claims:
            return []
        for claim in claims:
            claim.is_over = True
        ballot = claims[0].ballot
        outcomes = await self._council.confirm([claim.posted for claim in claims], ballot, ballot.proposer)
        pairs = zip(claims, outcomes, strict=True)
        works = [Deferred.fromCoroutine(self._settled(claim, outcome, wait)) for claim, outcome in pairs]
        try:
            return await gatherResults(works, consumeErrors=True)
        except FirstError as error:  # the node stops
            error.subFailure.raiseException()

    async def _settled(self, claim: Claim, outcome: Outcome, wait: Wait | None) -> bool:
        taker, place = claim.ballot.proposer, claim.posted.place
        winner = taker if outcome.result is Result.WON else outcome.value
        if winner is None:
            counter = max(claim.ballot.counter, outcome.counter)
            winner = await self._council.resolve(claim.posted, taker, taker, counter) or taker
        self._over(place, winner)
        if winner != taker:
            self._keeper.doubt(place, winner)
            return False
        with suppress(EntangledError):  # the node goes on to spread the note, and the council knows without it
            await self._keeper.note(place, winner)
        if wait is not None and wait.is_over:
            self._put_back(claim.fields)
        return True

    async def _complete(self, posted: Posted, value: bytes | None) -> None:
        place = posted.place
        self.held.add(place)
        try:
            winner = await self._council.resolve(posted, self._bidder(), value, self._counters.get(place, 0))
        finally:
            self.held.discard(place)
        if winner is not None:
            self._over(place, winner)
            self._keeper.doubt(place, winner)
            self._node.seat.settle(place)
        else:
            self._freed(place)

    def _missed(self, place: Place, outcome: Outcome) -> None:
        now = self._clock.seconds()
        if outcome.result is Result.DECIDED and outcome.value is not None:
            self._over(place, outcome.value)
            self._keeper.doubt(place, outcome.value)
        elif outcome.result is Result.HELD:
            self._not_before[place] = now + min(outcome.remaining, LEASED_RETRY) + self._rng.uniform(*CONTEST_RETRY)
        elif outcome.result is Result.OUTBID:
            self._not_before[place] = now + self._rng.uniform(*CONTEST_RETRY)
        else:
            self._not_before[place] = now + self._rng.uniform(*SILENT_RETRY)
        # Another call of this node may sleep because this one held the tuple: nothing else would wake it.
        self._free(place)

    def _over(self, place: Place, winner: bytes) -> None:
        self.held.discard(place)
        self._counters.pop(place, None)
        self._not_before.pop(place, None)
        self.gone[place] = winner
        _trim(self.gone)

    def _bidder(self) -> bytes:
        """A name under which nobody has ever bid, not even this node in an earlier life."""
        return self._node.identity.node_id + self._rng.randbytes(8)

    def _repair(self) -> None:
        """See to what this node accepted as a council member and never heard the end of."""
        late = [posted for posted in self._node.seat.unsettled() if posted.place.key in self._keeper.keys]
        for key in dict.fromkeys(posted.place.key for posted in late):
            _, taken = standing(self._node.store.get(key))
            for posted in late:
                if posted.place in taken:
                    self._node.seat.settle(posted.place)
                elif posted.place.key == key and posted.place not in self.held:
                    self._chores.fork(self._complete(posted, None))

    # -- claims that somebody holds ---------------------------------------------------------------------------------

    def confirm(self, claim: Claim) -> Deferred[Tuple]:
        """Have the council decide on a claim; what it decides for a call that was cancelled is put back."""
        wait = Wait()

        async def work() -> None:
            [won] = await self.decide([claim], wait)
            if wait.is_over:
                return
            if won:
                wait.deferred.callback(claim.fields)
            else:
                wait.deferred.errback(ClaimLost("the tuple was taken by another after the lease on it had ended"))

        self._chores.fork(work())
        return wait.deferred

    def release(self, claim: Claim) -> None:
        """Give up a claim, and tell its council."""
        self._council.release([claim.posted], claim.ballot)
        self._free(claim.posted.place)

    async def renew(self, claim: Claim) -> None:
        """Lease the tuple of a claim anew; raises ``ClaimLost`` and ``NoAnswer``."""
        sent = self._clock.seconds()
        [outcome] = await self._council.renew([claim.posted], claim.ballot, claim.lease)
        if outcome.result is Result.SILENT:
            raise NoAnswer("too little of the council answers to renew the lease")
        if outcome.result is not Result.WON or outcome.value is not None:
            raise ClaimLost("the tuple was claimed by another after the lease on it had ended")
        claim.deadline = sent + claim.lease * (1.0 - MARGIN)

    def _expire(self, claim: Claim) -> None:
        """Give up ``claim`` when its time is over, unless it was renewed."""
        left = claim.deadline - self._clock.seconds()
        if claim.is_over:
            return
        if left > 0:
            self._chores.later(left, self._expire, claim)
        else:
            self._free(claim.posted.place)

    def _free(self, place: Place) -> None:
        self.held.discard(place)
        self._freed(place)


def _trim(remembered: dict[Place, Any]) -> None:
    """Forget the oldest above the limit; whatever is forgotten the council knows."""
    while len(remembered) > MAX_REMEMBERED:
        del remembered[next(iter(remembered))]
