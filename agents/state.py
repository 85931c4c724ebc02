"""The states of one agent in one task, and the table (state, event) -> (state, effects); pure.

The table has a row for every pair: an event that says nothing to a state leaves it as it is.  Three rules can be read
from it.  EXECUTING is entered by GRANTED alone.  It is left with STOP as the first effect, before the lease is given
back.  An outcome absorbs all that follows.
"""

from __future__ import annotations

from collections.abc import Iterable
from enum import Enum
from typing import NamedTuple

from middleware.directory import presence


class State(Enum):
    """The states of one agent in one task, each with the coarse status that the page shows for it."""

    IDLE = presence.ASSIGNED, "has no body for the task: another task has it, or this one is paused"
    OBSERVING = presence.SEARCHING, "has nothing to report yet: `behaviour.search`"
    REPORTED = presence.WAITING, "waits for the reports of others: `behaviour.hold`"
    WAITING = presence.WAITING, "stands by while another should act; its rank is its place in the line"
    CLAIMING = presence.WAITING, "should act, and asks the council for the lease"
    EXECUTING = presence.EXECUTING, "holds the lease, and acts: `behaviour.execute`"
    RELEASING = presence.WAITING, "has stopped its body, and keeps the lease until the outcome is recorded"
    FENCED = presence.WAITING, "has stopped its body: its lease ran out, or the body obeyed a newer token"
    DONE = presence.DONE, "knows the outcome of the task"

    def __init__(self, status: str, text: str) -> None:
        self.status = status
        self.text = text


class Event(Enum):
    """What happens to an agent in a task."""

    NO_BODY = "the task is paused, or the body is another task's"
    FREE = "the body is free for the task"
    LATE = "the task is past its deadline; this agent is to end it, and does not hold the lease"
    EXPIRED = "the same, and it holds the lease"
    BLIND = "another should act or nobody, and this agent has no cost to report"
    UNDECIDED = "nobody is named yet"
    PASSED_OVER = "another should act"
    LEASED_IN_VAIN = "another should act, and this agent holds the lease"
    NAMED = "this agent should act, and does not hold the lease"
    GRANTED = "this agent should act, or cannot stop yet, and holds the lease"
    MOVE = "the council is to change, and the body may be stopped for it"
    FINISHED = "the behaviour has nothing left to do"
    OUTRANKED = "the body has obeyed a newer token than that of the lease"
    LENT = "the body goes to another task of the group"
    LEAVE = "the agent leaves the task"
    REOPENED = "a higher token was granted before the outcome was recorded"
    OUTCOME = "the task has an outcome"


class Effect(Enum):
    """What the agent does because of an event."""

    STOP = "stop the body"
    RELEASE = "give the lease back, or stop claiming it"
    GIVE_BACK = "give the lease back, and say so to people"
    HAND_OVER = "give the lease back for good, and tell those that stand by"
    WANT = "claim the lease, or keep it"
    CLAIM = "claim the lease, and begin to wait for it"
    INSIST = "claim the lease, and report again each second"
    STAND_BY = "line up at the council, where the rank is low enough"
    CHANGE_COUNCIL = "have the council changed; the lease goes back with it, and is claimed again"
    OFFER = "count the body as free in the next report"
    WITHDRAW = "take the report back"
    START = "say to people that the agent goes"
    EXECUTE = "do the next bit of the task, under the lease"
    HOLD = "report the decision, and search or stand by meanwhile"
    COMPLETE = "record that the task is completed"
    FAIL = "record that the task has failed"
    END = "report the end"


class Row(NamedTuple):
    """In each of ``states`` the event leads to ``target`` (None: nowhere) with these effects."""

    event: Event
    states: tuple[State, ...]
    target: State | None = None
    effects: tuple[Effect, ...] = ()


_S, _V, _E = State, Event, Effect
_RESTING = _S.OBSERVING, _S.REPORTED, _S.WAITING, _S.FENCED
_PRESENT = *_RESTING, _S.CLAIMING
_ASIDE = _S.IDLE, *_PRESENT
_ACTING = (_S.EXECUTING,)
_SETTLED = _S.RELEASING, _S.DONE
_NOT_ACTING = *_ASIDE, *_SETTLED
_STANDS_BY = _E.STAND_BY, _E.HOLD
_GIVES_BACK = _E.STOP, _E.GIVE_BACK

ROWS = (
    Row(_V.NO_BODY, _ASIDE, _S.IDLE, (_E.RELEASE, _E.WITHDRAW)),
    Row(_V.NO_BODY, _ACTING, _S.IDLE, (*_GIVES_BACK, _E.WITHDRAW)),
    Row(_V.NO_BODY, _SETTLED),
    Row(_V.FREE, (_S.IDLE,), _S.OBSERVING, (_E.OFFER,)),
    Row(_V.FREE, (*_PRESENT, *_ACTING, *_SETTLED)),
    # An agent ends only a task whose lease it holds.
    Row(_V.LATE, _ASIDE, None, (_E.WANT,)),
    Row(_V.LATE, _ACTING, _S.FENCED, (_E.STOP, _E.WANT)),
    Row(_V.LATE, _SETTLED),
    Row(_V.EXPIRED, _ASIDE, _S.RELEASING, (_E.FAIL,)),
    Row(_V.EXPIRED, _ACTING, _S.RELEASING, (_E.STOP, _E.FAIL)),
    Row(_V.EXPIRED, _SETTLED),
    Row(_V.BLIND, _PRESENT, _S.OBSERVING, (_E.RELEASE, _E.HOLD)),
    Row(_V.BLIND, _ACTING, _S.OBSERVING, (*_GIVES_BACK, _E.HOLD)),
    Row(_V.BLIND, (_S.IDLE, *_SETTLED)),
    Row(_V.UNDECIDED, _PRESENT, _S.REPORTED, (_E.RELEASE, _E.HOLD)),
    Row(_V.UNDECIDED, _ACTING, _S.REPORTED, (*_GIVES_BACK, _E.HOLD)),
    Row(_V.UNDECIDED, (_S.IDLE, *_SETTLED)),
    # An agent that only stands by, and holds nothing, keeps its place in the line.
    Row(_V.PASSED_OVER, _RESTING, _S.WAITING, _STANDS_BY),
    Row(_V.PASSED_OVER, (_S.CLAIMING,), _S.WAITING, (_E.RELEASE, *_STANDS_BY)),
    Row(_V.PASSED_OVER, _ACTING, _S.WAITING, (*_GIVES_BACK, *_STANDS_BY)),
    Row(_V.PASSED_OVER, (_S.IDLE, *_SETTLED)),
    Row(_V.LEASED_IN_VAIN, _PRESENT, _S.WAITING, (_E.RELEASE, *_STANDS_BY)),
    Row(_V.LEASED_IN_VAIN, _ACTING, _S.WAITING, (*_GIVES_BACK, *_STANDS_BY)),
    Row(_V.LEASED_IN_VAIN, (_S.IDLE, *_SETTLED)),
    Row(_V.NAMED, _RESTING, _S.CLAIMING, (_E.CLAIM, _E.HOLD)),
    Row(_V.NAMED, (_S.CLAIMING,), None, (_E.INSIST, _E.HOLD)),
    Row(_V.NAMED, _ACTING, _S.FENCED, (_E.STOP, _E.WANT, _E.HOLD)),
    Row(_V.NAMED, (_S.IDLE, *_SETTLED)),
    Row(_V.GRANTED, _PRESENT, _S.EXECUTING, (_E.WANT, _E.START, _E.EXECUTE)),
    Row(_V.GRANTED, _ACTING, None, (_E.WANT, _E.EXECUTE)),
    Row(_V.GRANTED, (_S.IDLE, *_SETTLED)),
    # It stays the one that acts, so that no other is named; it stands until it has its lease again.
    Row(_V.MOVE, _ACTING, None, (_E.STOP, _E.CHANGE_COUNCIL)),
    Row(_V.MOVE, _NOT_ACTING),
    Row(_V.FINISHED, _ACTING, _S.RELEASING, (_E.STOP, _E.COMPLETE)),
    Row(_V.FINISHED, _NOT_ACTING),
    # To an agent that only stands by it says nothing: the body remembers what a former life of its agent did.
    Row(_V.OUTRANKED, _ACTING, _S.FENCED, (_E.STOP, _E.RELEASE)),
    Row(_V.OUTRANKED, _NOT_ACTING),
    Row(_V.LENT, _ASIDE, None, (_E.RELEASE,)),
    Row(_V.LENT, _ACTING, _S.FENCED, _GIVES_BACK),
    Row(_V.LENT, _SETTLED),
    Row(_V.LEAVE, _NOT_ACTING, None, (_E.HAND_OVER,)),
    Row(_V.LEAVE, _ACTING, _S.FENCED, (_E.STOP, _E.HAND_OVER)),
    Row(_V.REOPENED, (_S.RELEASING,), _S.FENCED, (_E.RELEASE,)),
    Row(_V.REOPENED, (*_ASIDE, *_ACTING, _S.DONE)),
    Row(_V.OUTCOME, (*_ASIDE, _S.RELEASING), _S.DONE, (_E.END,)),
    Row(_V.OUTCOME, _ACTING, _S.DONE, (_E.STOP, _E.END)),
    Row(_V.OUTCOME, (_S.DONE,)),
)


def build_table(rows: Iterable[Row]) -> dict[tuple[State, Event], tuple[State, tuple[Effect, ...]]]:
    """Return the table of ``rows``, one entry for each pair that they name."""
    return {(state, row.event): (row.target or state, row.effects) for row in rows for state in row.states}


TABLE = build_table(ROWS)
"""(state, event) to (next state, effects in their order)."""


class Course:
    """The way of one agent through one task; ``rank`` is its place among those that stand by, from 1."""

    def __init__(self) -> None:
        self.state = State.IDLE
        self.rank = 0

    def __str__(self) -> str:
        """The state as people read it."""
        return f"{self.state.name}({self.rank})" if self.state is State.WAITING and self.rank else self.state.name

    def go(self, event: Event, rank: int | None = None) -> tuple[Effect, ...]:
        """Take the step of ``event`` and return its effects; ``rank`` is the new rank, where the event gives one."""
        self.state, effects = TABLE[self.state, event]
        if rank is not None:
            self.rank = rank
        return effects
