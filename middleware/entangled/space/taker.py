"""Claims and takes of tuples, and completion of takes that other nodes left unfinished."""

from __future__ import annotations

import random
import zlib
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

from twisted.internet.defer import Deferred, FirstError, fail, gatherResults, maybeDeferred
from twisted.internet.interfaces import IReactorTime

from middleware.entangled.background import Background, gather_first
from middleware.entangled.contact import Contact
from middleware.entangled.errors import EntangledError, NoAnswer, Refused
from middleware.entangled.kademlia.distance import select_closest
from middleware.entangled.listeners import Listeners
from middleware.entangled.quorum.ballot import Ballot
from middleware.entangled.quorum.proposer import Outcome, Result
from middleware.entangled.space.node_interface import NodeInterface
from middleware.entangled.space.slot_maintenance import SlotMaintenance
from middleware.entangled.space.take_acceptor import MAX_TUPLES
from middleware.entangled.space.take_proposer import TakeProposer
from middleware.entangled.space.template import Template, Tuple
from middleware.entangled.space.tuple_record import INCARNATION_BYTES, Member, StoredTuple, TupleId, parse_records

CLOCK_DRIFT = 0.02
"""The maximum relative drift between the clocks of two correct nodes (1 % each)."""
COUNCIL_CACHE_S = 5.0
"""Seconds for which the enrolled council of a key is reused."""
MAX_ENROLMENTS = 3
"""The number of attempts to look up and enrol the nodes closest to a key."""
REPAIR_INTERVAL_S = 2.0
LEASED_RETRY_S = 0.5
CONTEST_RETRY_S = (0.02, 0.08)
SILENT_RETRY_S = (0.2, 0.6)
MAX_REMEMBERED = 10_000
OVER_TEXT = "the claim has already been confirmed or released"


class ClaimLost(Refused):
    """Another claimant took the tuple; the caller must discard its work on it."""


class WaitingCall:
    """A call that waits for a tuple; ``is_over`` once it has fired, was cancelled or timed out."""

    def __init__(self) -> None:
        self.is_over = False
        self.deferred: Deferred[Any] = Deferred(lambda _: self.end())
        self.on_end = Listeners[[]]()

    def end(self) -> None:
        """End the call, and notify ``on_end``."""
        if not self.is_over:
            self.is_over = True
            self.on_end()


@dataclass
class Claim:
    """The exclusive right to take a tuple until ``deadline`` (seconds of the node's clock).

    Confirm the claim when the work is done.  A claim that is neither confirmed nor renewed expires, so that the tuple
    of a failed taker becomes available again.
    """

    stored_tuple: StoredTuple
    ballot: Ballot
    lease: float
    deadline: float
    _taker: Taker = field(repr=False)
    is_over: bool = False

    @property
    def fields(self) -> Tuple:
        """The tuple."""
        return self.stored_tuple.fields

    def confirm(self) -> Deferred[Tuple]:
        """Take the tuple permanently; fires when the council has decided.

        Fails with ``ClaimLost`` if the council decided for another claimant, which is possible only after the deadline.
        If the call is cancelled, but the council decides in its favour, the tuple is put back.
        """
        return fail(ClaimLost(OVER_TEXT)) if self.is_over else self._taker.confirm(self)

    def release(self) -> None:
        """Make the tuple available to other takers immediately."""
        if not self.is_over:
            self.is_over = True
            self._taker.release(self)

    def renew(self) -> Deferred[None]:
        """Renew the lease from now.

        Fails with ``ClaimLost``, or with ``NoAnswer`` if too few members answer but the lease is still valid.
        """
        return fail(ClaimLost(OVER_TEXT)) if self.is_over else Deferred.fromCoroutine(self._taker.renew(self))


class Taker:
    """The takes of one node in one space; ``claimed`` are its claimed tuples, ``taken`` the tuples known to be taken.

    ``on_freed`` is called when this node gives up a tuple that it claimed or failed to claim.  ``on_unwanted`` is
    called with a tuple that was confirmed for a call that has already ended.
    """

    def __init__(
        self,
        node: NodeInterface,
        clock: IReactorTime,
        rng: random.Random,
        background: Background,
        slots: SlotMaintenance,
        council_size: int,
        on_freed: Callable[[TupleId], None],
        on_unwanted: Callable[[Tuple], object],
    ) -> None:
        self._on_freed = on_freed
        self._on_unwanted = on_unwanted
        self.claimed: set[TupleId] = set()
        self.taken: dict[TupleId, bytes] = {}
        self._node = node
        self._clock = clock
        self._rng = rng
        self._background = background
        self._slots = slots
        self._council_size = council_size
        self._proposer = TakeProposer(self._ask, clock, rng, background)
        self._seed = zlib.crc32(node.identity.node_id)
        self._counters: dict[TupleId, int] = {}
        self._not_before: dict[TupleId, float] = {}
        self._members: dict[bytes, tuple[float, list[Member]]] = {}
        background.every(REPAIR_INTERVAL_S, self._complete_unfinished)

    # -- councils ---------------------------------------------------------------------------------------------------

    async def enrol_council(self, key: bytes) -> list[Member]:
        """Return the council for a new tuple: the live nodes closest to ``key``, including this node.

        The council is smaller than configured only if the network has fewer nodes.  Fails with ``NoAnswer`` if other
        nodes do not answer, because a council of one or two would not survive the loss of a member.
        """
        until, members = self._members.get(key, (0.0, []))
        if until > self._clock.seconds():
            return members
        members = []
        for _ in range(MAX_ENROLMENTS):
            near = select_closest([*await self._node.find_node(key), self._node.contact], key, 2 * self._council_size)
            agreed = {member.contact.node_id for member in members}
            left, silent = [contact for contact in near if contact.node_id not in agreed], 0
            while left and len(members) < self._council_size:
                requested, left = left[: self._council_size - len(members)], left[self._council_size - len(members) :]
                answers = await gather_first(len(requested), [self._enrol(contact) for contact in requested])
                members += [member for member in answers if member is not None]
                silent += len(requested) - len(answers)
            if members and (len(members) == self._council_size or not silent):
                self._members[key] = (self._clock.seconds() + COUNCIL_CACHE_S, members)
                return members
        raise NoAnswer(
            f"only {len(members)} of {self._council_size} nodes agreed to be in the council of the tuple; try again"
        )

    async def _enrol(self, contact: Contact) -> Member | None:
        """Ask the node to be a member of the council; return None if it does not agree."""
        try:
            incarnation = await self._ask(contact, "decree.enrol", ())
        except Refused:
            return None
        is_valid = isinstance(incarnation, bytes) and len(incarnation) == INCARNATION_BYTES
        return Member(contact, incarnation) if is_valid else None

    def _ask(self, contact: Contact, method: str, arguments: tuple[object, ...]) -> Deferred[Any]:
        node = self._node
        if contact.node_id == node.identity.node_id:
            answer = getattr(node.take_acceptor, method.replace("decree.", "answer_"))
            return maybeDeferred(answer, node.contact, *arguments)
        # A member may have a new address since the tuple was put; its key is still the same.
        return node.endpoint.ask(node.find_newest(contact), method, *arguments, changes=method != "decree.enrol")

    # -- choosing ---------------------------------------------------------------------------------------------------

    def find_candidates(
        self, tuples: Sequence[StoredTuple], template: Template, is_patient: bool = True
    ) -> tuple[list[StoredTuple], float | None]:
        """Return the tuples to try now, in this node's order, and the seconds until another tuple may be tried.

        Each node has a different order, so that takers rarely compete for a tuple.  Tuples that this node failed to
        claim come last, the oldest failure first, so that tuples with an unreachable council do not block the others.
        """
        now = self._clock.seconds()
        open_ = [p for p in tuples if p.tuple_id not in self.taken and p.tuple_id not in self.claimed]
        fitting = [p for p in open_ if template.matches(p.fields)]
        ready = [p for p in fitting if not is_patient or self._not_before.get(p.tuple_id, 0.0) <= now]
        ready.sort(
            key=lambda p: (self._not_before.get(p.tuple_id, 0.0), zlib.crc32(p.tuple_id.mark, self._seed), p.tuple_id)
        )
        times = [self._not_before[p.tuple_id] for p in fitting if p.tuple_id in self._not_before]
        return ready, min((max(0.001, time - now) for time in times), default=None)

    def select_batch(self, tuples: Sequence[StoredTuple], most: int) -> list[StoredTuple]:
        """Return the first of ``tuples`` and further tuples of its council, as many as fit into one request."""
        same_council = [one for one in tuples if one.council == tuples[0].council]
        return same_council[: min(most, MAX_TUPLES)]

    # -- taking -----------------------------------------------------------------------------------------------------

    async def claim(self, tuples: Sequence[StoredTuple], lease: float) -> tuple[list[Claim], bool]:
        """Claim tuples of one council; return the claims that were won, and whether too few members answered."""
        places = [one.tuple_id for one in tuples]
        self.claimed.update(places)
        ballot = Ballot(1 + max(self._counters.get(tuple_id, 0) for tuple_id in places), self._make_proposer_name())
        sent = self._clock.seconds()
        outcomes = await self._proposer.claim(tuples, ballot, lease)
        claims = []
        for one, outcome in zip(tuples, outcomes, strict=True):
            self._counters[one.tuple_id] = max(ballot.counter, outcome.counter)
            if outcome.result is Result.WON and outcome.value is None:
                deadline = sent + lease * (1.0 - CLOCK_DRIFT)
                claims.append(Claim(one, ballot, lease, deadline, self))
                self._expire(claims[-1])
            elif outcome.result is Result.WON:
                # A taker failed during its confirmation: complete the confirmation in that taker's name.
                self._background.fork(self._complete(one, outcome.value))
            else:
                self._note_failed_claim(one.tuple_id, outcome)
        _limit_size(self._counters)
        _limit_size(self._not_before)
        return claims, any(outcome.result is Result.SILENT for outcome in outcomes)

    async def decide(self, claims: Sequence[Claim], wait: WaitingCall | None = None) -> list[bool]:
        """Confirm claims of one ballot; return for each claim whether this node took the tuple.

        Retries until the council has decided, because as long as this node may have won a tuple, no other node can take
        it.  A tuple that this node wins after the call has ended is put back.
        """
        if not claims:
            return []
        for claim in claims:
            claim.is_over = True
        ballot = claims[0].ballot
        outcomes = await self._proposer.confirm([claim.stored_tuple for claim in claims], ballot, ballot.proposer)
        pairs = zip(claims, outcomes, strict=True)
        works = [Deferred.fromCoroutine(self._finish_decision(claim, outcome, wait)) for claim, outcome in pairs]
        try:
            return await gatherResults(works, consumeErrors=True)
        except FirstError as error:  # the node is stopping
            error.subFailure.raiseException()

    async def _finish_decision(self, claim: Claim, outcome: Outcome, wait: WaitingCall | None) -> bool:
        taker, tuple_id = claim.ballot.proposer, claim.stored_tuple.tuple_id
        winner = taker if outcome.result is Result.WON else outcome.value
        if winner is None:
            counter = max(claim.ballot.counter, outcome.counter)
            winner = await self._proposer.resolve(claim.stored_tuple, taker, taker, counter) or taker
        self._forget_taken(tuple_id, winner)
        if winner != taker:
            self._slots.check_taken_note(tuple_id, winner)
            return False
        with suppress(EntangledError):  # harmless: the node republishes the note later, and the council knows the taker
            await self._slots.put_taken_note(tuple_id, winner)
        if wait is not None and wait.is_over:
            self._on_unwanted(claim.fields)
        return True

    async def _complete(self, stored: StoredTuple, value: bytes | None) -> None:
        tuple_id = stored.tuple_id
        self.claimed.add(tuple_id)
        try:
            winner = await self._proposer.resolve(
                stored, self._make_proposer_name(), value, self._counters.get(tuple_id, 0)
            )
        finally:
            self.claimed.discard(tuple_id)
        if winner is not None:
            self._forget_taken(tuple_id, winner)
            self._slots.check_taken_note(tuple_id, winner)
            self._node.take_acceptor.finish(tuple_id)
        else:
            self._on_freed(tuple_id)

    def _note_failed_claim(self, tuple_id: TupleId, outcome: Outcome) -> None:
        now = self._clock.seconds()
        if outcome.result is Result.DECIDED and outcome.value is not None:
            self._forget_taken(tuple_id, outcome.value)
            self._slots.check_taken_note(tuple_id, outcome.value)
        elif outcome.result is Result.HELD:
            self._not_before[tuple_id] = (
                now + min(outcome.remaining, LEASED_RETRY_S) + self._rng.uniform(*CONTEST_RETRY_S)
            )
        elif outcome.result is Result.OUTBID:
            self._not_before[tuple_id] = now + self._rng.uniform(*CONTEST_RETRY_S)
        else:
            self._not_before[tuple_id] = now + self._rng.uniform(*SILENT_RETRY_S)
        # Wake other calls of this node, which wait because this call held the tuple.
        self._free_tuple(tuple_id)

    def _forget_taken(self, tuple_id: TupleId, winner: bytes) -> None:
        self.claimed.discard(tuple_id)
        self._counters.pop(tuple_id, None)
        self._not_before.pop(tuple_id, None)
        self.taken[tuple_id] = winner
        _limit_size(self.taken)

    def _make_proposer_name(self) -> bytes:
        """Return a new unique name for a ballot of this node."""
        return self._node.identity.node_id + self._rng.randbytes(8)

    def _complete_unfinished(self) -> None:
        """Complete takes that this node accepted as a council member but has not seen completed."""
        late = [
            stored for stored in self._node.take_acceptor.list_unfinished() if stored.tuple_id.key in self._slots.keys
        ]
        for key in dict.fromkeys(stored.tuple_id.key for stored in late):
            _, taken = parse_records(self._node.store.get(key))
            for stored in late:
                if stored.tuple_id in taken:
                    self._node.take_acceptor.finish(stored.tuple_id)
                elif stored.tuple_id.key == key and stored.tuple_id not in self.claimed:
                    self._background.fork(self._complete(stored, None))

    # -- methods of a claim -----------------------------------------------------------------------------------------

    def confirm(self, claim: Claim) -> Deferred[Tuple]:
        """Confirm a claim; if the call is cancelled, but the council decides in its favour, put the tuple back."""
        wait = WaitingCall()

        async def work() -> None:
            [won] = await self.decide([claim], wait)
            if wait.is_over:
                return
            if won:
                wait.deferred.callback(claim.fields)
            else:
                wait.deferred.errback(ClaimLost("another node took the tuple after the claim had expired"))

        self._background.fork(work())
        return wait.deferred

    def release(self, claim: Claim) -> None:
        """Give up a claim, and notify its council."""
        self._proposer.release([claim.stored_tuple], claim.ballot)
        self._free_tuple(claim.stored_tuple.tuple_id)

    async def renew(self, claim: Claim) -> None:
        """Renew the lease of a claim; raises ``ClaimLost`` and ``NoAnswer``."""
        sent = self._clock.seconds()
        [outcome] = await self._proposer.renew([claim.stored_tuple], claim.ballot, claim.lease)
        if outcome.result is Result.SILENT:
            raise NoAnswer("too few council members answered to renew the claim; try again before its deadline")
        if outcome.result is not Result.WON or outcome.value is not None:
            raise ClaimLost("another node claimed the tuple after the claim had expired")
        claim.deadline = sent + claim.lease * (1.0 - CLOCK_DRIFT)

    def _expire(self, claim: Claim) -> None:
        """Give up ``claim`` at its deadline, unless it was renewed."""
        left = claim.deadline - self._clock.seconds()
        if claim.is_over:
            return
        if left > 0:
            self._background.later(left, self._expire, claim)
        else:
            self._free_tuple(claim.stored_tuple.tuple_id)

    def _free_tuple(self, tuple_id: TupleId) -> None:
        self.claimed.discard(tuple_id)
        self._on_freed(tuple_id)


def _limit_size(remembered: dict[TupleId, Any]) -> None:
    """Drop the oldest entries above the limit; the councils still know these takes."""
    while len(remembered) > MAX_REMEMBERED:
        del remembered[next(iter(remembered))]
