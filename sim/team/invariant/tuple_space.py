"""Invariants of the tuple space, T1 to T6: tuples that were put, taken, read and waited for."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Hashable, Iterable, Iterator

from sim.team.event import (
    Answered,
    AnswerRepeated,
    Asked,
    Event,
    LivingMembers,
    Settled,
    TupleStored,
    Unanswered,
    VoteAccepted,
)

KINDS = Asked, Answered, Unanswered, Settled, TupleStored, VoteAccepted, LivingMembers, AnswerRepeated
"""The events that these invariants use."""
WAKE_LIMIT_S = 1.0
"""T6: seconds within which a waiting client must be notified."""
PUT, TAKE, SURVEY, WAIT, RING = "put", "take", "survey", "wait", "ring"
"""Client operations: put a tuple, take tuples, read all tuples, wait for the bell tuple, put the bell tuple."""


class _TupleSpaceState:
    """The state of all tuples after the events that have been applied."""

    def __init__(self) -> None:
        self.tuples: dict[Hashable, TupleStored] = {}
        self.members: dict[bytes, bytes] = {}
        self.votes: dict[Hashable, dict[tuple[Hashable, bytes], set[bytes]]] = defaultdict(lambda: defaultdict(set))

    def apply(self, event: Event) -> None:
        """Apply an event."""
        match event:
            case TupleStored(_, mark):
                self.tuples[mark] = event
            case VoteAccepted(_, mark, ballot, taker, member):
                self.votes[mark][ballot, taker].add(member)
            case LivingMembers(_, members):
                self.members = dict(members)

    def find_takers(self, mark: Hashable) -> set[bytes]:
        """Return all takers that a majority of the council has ever accepted under the same ballot."""
        quorum = len(self.tuples[mark].council) // 2 + 1
        return {taker for (_, taker), members in self.votes[mark].items() if len(members) >= quorum}

    def can_decide(self, stored_tuple: TupleStored) -> bool:
        """Return whether a majority of the tuple's council lives and has not lost its votes."""
        members = zip(stored_tuple.council, stored_tuple.incarnations, strict=True)
        able = [member for member, incarnation in members if self.members.get(member) == incarnation]
        return 2 * len(able) > len(stored_tuple.council)


def t1(events: Iterable[Event]) -> Iterator[str]:
    """One taker: no tuple is confirmed to two takers, either by two majorities or in answers to clients."""
    space, confirmed = _TupleSpaceState(), defaultdict[Hashable, list[str]](list)
    taking: dict[int, Asked] = {}
    for event in events:
        space.apply(event)
        match event:
            case Asked(_, number, _, "take"):
                taking[number] = event
            case Answered(at, number, tuple() as taken) if number in taking:
                for fields in taken:
                    confirmed[fields].append(f"node {taking[number].client} at {at:.1f}")
    for mark, stored_tuple in space.tuples.items():
        if len(space.find_takers(mark)) > 1:
            yield f"{stored_tuple.fields} was accepted for two"
    for fields, ways in confirmed.items():
        if len(ways) > 1:
            yield f"{fields} was confirmed to {' and '.join(ways)}"


def t2(events: Iterable[Event]) -> Iterator[str]:
    """Durability: readers see acknowledged tuples that were not taken; after the repair interval requests succeed."""
    space = _TupleSpaceState()
    requests: dict[int, Asked] = {}
    acknowledged: dict[Hashable, None] = {}
    wanted: dict[int, tuple[Hashable, ...]] = {}
    is_over, is_rung = False, True
    for event in events:
        space.apply(event)
        match event:
            case Settled():
                is_over = True
            case Asked(_, number, _, what):
                requests[number] = event
                is_rung = is_rung and what != RING
                if what == SURVEY:
                    wanted[number] = tuple(acknowledged)
            case Answered(_, number, result) if number in requests:
                what, subject = requests[number].what, requests[number].subject
                if what == PUT:
                    acknowledged[subject] = None
                is_rung = is_rung or what == RING
                if what == SURVEY and isinstance(result, tuple):
                    yield from _find_unseen(space, wanted.pop(number), set(result), requests[number].client)
            case Unanswered(_, number, why) if (
                is_over and number in requests and requests[number].what in (SURVEY, RING)
            ):
                what = "a put" if requests[number].what == RING else "a read of all tuples"
                yield f"{what} fails after everything healed: {why}"
    if not is_rung:
        yield "a put is not acknowledged after everything healed"


def _find_unseen(
    space: _TupleSpaceState, acknowledged: Iterable[Hashable], seen: set[Hashable], client: Hashable
) -> Iterator[str]:
    known = {stored_tuple.fields: mark for mark, stored_tuple in space.tuples.items()}
    for fields in acknowledged:
        is_lost = fields not in known or not (space.find_takers(known[fields]) or fields in seen)
        if is_lost:
            yield f"{fields} was acknowledged and not taken; node {client} does not see it"


def t3(events: Iterable[Event]) -> Iterator[str]:
    """Finality: a survey that starts after a confirmed take does not return the taken tuple."""
    space = _TupleSpaceState()
    requests: dict[int, Asked] = {}
    confirmed: dict[Hashable, str] = {}
    over: dict[int, dict[Hashable, str]] = {}
    for event in events:
        space.apply(event)
        match event:
            case Asked(_, number, _, what):
                requests[number] = event
                if what == SURVEY:
                    over[number] = dict(confirmed)
            case Answered(at, number, tuple() as result) if number in requests:
                client = requests[number].client
                if requests[number].what == TAKE:
                    for fields in result:
                        confirmed.setdefault(fields, f"node {client} at {at:.1f}")
                elif requests[number].what == SURVEY:
                    before, known = (
                        over.pop(number),
                        {stored_tuple.fields: stored_tuple for stored_tuple in space.tuples.values()},
                    )
                    for fields in result:
                        if fields in before and space.can_decide(known[fields]):
                            yield f"{fields} was taken by {before[fields]}; node {client} still sees it"


def t4(events: Iterable[Event]) -> Iterator[str]:
    """Same answer: a member that accepted the decided value repeats this value in every later answer."""
    for event in events:
        if isinstance(event, AnswerRepeated) and event.answer != event.taker:
            value = event.answer.hex()[:6] if event.answer else event.answer
            yield f"a member changed its answer about {event.fields}: {value}"


def t5(events: Iterable[Event]) -> Iterator[str]:
    """Returned claims: at the end no dead taker holds an acknowledged tuple whose council can decide."""
    space = _TupleSpaceState()
    putting: dict[int, Hashable] = {}
    acknowledged: set[Hashable] = set()
    is_over = False
    for event in events:
        space.apply(event)
        match event:
            case Settled():
                is_over = True
            case Asked(_, number, _, "put", fields):
                putting[number] = fields
            case Answered(_, number) if number in putting:
                acknowledged.add(putting.pop(number))
    for mark, stored_tuple in space.tuples.items() if is_over else ():
        if stored_tuple.fields in acknowledged and not space.find_takers(mark) and space.can_decide(stored_tuple):
            yield f"{stored_tuple.fields} is not held by a living taker, and cannot be taken"


def t6(events: Iterable[Event]) -> Iterator[str]:
    """Wake-up: a client that waits when the bell tuple is put is notified within a second, unless its node dies."""
    waiting: dict[int, Asked] = {}
    heard: dict[int, float] = {}
    ringing: dict[int, float | None] = {}
    for event in events:
        match event:
            case Asked(_, number, _, "wait"):
                waiting[number] = event
            case Asked(_, number, _, "ring"):
                ringing[number] = None
            case Answered(at, number) if number in waiting:
                heard[number] = at
            case Answered(at, number) if number in ringing:
                ringing[number] = at
            case Unanswered(_, number):
                waiting.pop(number, None)
    rung_at = next((at for at in ringing.values() if at is not None), None)
    if rung_at is None:
        return
    for number, asked in waiting.items():
        heard_at = heard.get(number)
        if heard_at is None or heard_at > rung_at + WAKE_LIMIT_S:
            late = "never" if heard_at is None else f"{heard_at - rung_at:.2f} s later"
            yield f"{asked.subject}, hears the bell {late}"
