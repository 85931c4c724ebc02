"""The states of one agent in one task, and the table (state, event) -> (state, effects); pure.

The table has a row for every pair: an event that has no meaning in a state leaves the state unchanged. The table
ensures three rules. Only the event GRANTED leads to EXECUTING. STOP is the first effect of each event that leaves
EXECUTING, so the robot stops before the lease is released. DONE is final.
"""

from __future__ import annotations

from collections.abc import Iterable
from enum import Enum
from typing import NamedTuple

from middleware.directory import presence


class State(Enum):
    """The states of one agent in one task, each with the status that the page shows for it."""

    IDLE = presence.ASSIGNED, "has no robot for the task: another task has it, or this one is paused"
    OBSERVING = presence.SEARCHING, "has nothing to report yet: `behaviour.search`"
    REPORTED = presence.WAITING, "waits for the reports of other agents: `behaviour.hold`"
    WAITING = presence.WAITING, "is a standby while another agent should act; its rank is its place among the standbys"
    CLAIMING = presence.WAITING, "should act, and requests the lease from the quorum members"
    EXECUTING = presence.EXECUTING, "holds the lease, and acts: `behaviour.execute`"
    RELEASING = presence.WAITING, "has stopped its robot, and keeps the lease until the outcome is recorded"
    FENCED = presence.WAITING, "has stopped its robot: its lease expired, or the robot obeyed a newer token"
    DONE = presence.DONE, "knows the outcome of the task"

    def __init__(self, status: str, text: str) -> None:
        self.status = status
        self.text = text


class Event(Enum):
    """The events of an agent in a task."""

    NO_BODY = "the task is paused, or another task has the robot"
    FREE = "the robot is free for the task"
    LATE = "the task is past its deadline; this agent must end it, and does not hold the lease"
    EXPIRED = "the task is past its deadline; this agent must end it, and holds the lease"
    BLIND = "another agent or none should act, and this agent has no cost to report"
    UNDECIDED = "no agent is assigned yet"
    PASSED_OVER = "another agent should act"
    LEASED_IN_VAIN = "another agent should act, and this agent holds the lease"
    NAMED = "this agent should act, and does not hold the lease"
    GRANTED = "this agent should act, or cannot stop yet, and holds the lease"
    MOVE = "the quorum is to change, and the robot may be stopped for it"
    FINISHED = "the behaviour has finished"
    OUTRANKED = "the robot has obeyed a newer token than the lease's"
    LENT = "the robot is given to another task of the group"
    LEAVE = "the agent leaves the task"
    REOPENED = "a higher token was granted before the outcome was recorded"
    OUTCOME = "the task has an outcome"


class Effect(Enum):
    """The effects of an event."""

    STOP = "stop the robot"
    RELEASE = "release the lease, or stop claiming it"
    GIVE_BACK = "release the lease, and log it on the page"
    HAND_OVER = "release the lease and notify the standbys"
    WANT = "claim the lease, or keep it"
    CLAIM = "claim the lease, and start to wait for it"
    INSIST = "claim the lease, and report again each second"
    STAND_BY = "poll the quorum members as a standby, if the rank is low enough"
    CHANGE_COUNCIL = "change the quorum; the lease is released with it, and claimed again"
    OFFER = "report the robot as available in the next report"
    WITHDRAW = "withdraw the report"
    START = "log on the page that the agent acts"
    EXECUTE = "perform the next action of the task, under the lease"
    HOLD = "report the decision, and search or hold until the lease is granted"
    COMPLETE = "record that the task is completed"
    FAIL = "record that the task has failed"
    END = "report the end"


class Row(NamedTuple):
    """A row of the table: ``event`` leads from ``states`` to ``target`` (None: no change) with ``effects``."""

    event: Event
    states: tuple[State, ...]
    target: State | None = None
    effects: tuple[Effect, ...] = ()


_S, _V, _E = State, Event, Effect
_WAITING_STATES = _S.OBSERVING, _S.REPORTED, _S.WAITING, _S.FENCED
_PRESENT_STATES = *_WAITING_STATES, _S.CLAIMING
_INACTIVE_STATES = _S.IDLE, *_PRESENT_STATES
_ACTING_STATES = (_S.EXECUTING,)
_SETTLED_STATES = _S.RELEASING, _S.DONE
_NOT_ACTING_STATES = *_INACTIVE_STATES, *_SETTLED_STATES
_STAND_BY_EFFECTS = _E.STAND_BY, _E.HOLD
_GIVE_BACK_EFFECTS = _E.STOP, _E.GIVE_BACK

ROWS = (
    Row(_V.NO_BODY, _INACTIVE_STATES, _S.IDLE, (_E.RELEASE, _E.WITHDRAW)),
    Row(_V.NO_BODY, _ACTING_STATES, _S.IDLE, (*_GIVE_BACK_EFFECTS, _E.WITHDRAW)),
    Row(_V.NO_BODY, _SETTLED_STATES),
    Row(_V.FREE, (_S.IDLE,), _S.OBSERVING, (_E.OFFER,)),
    Row(_V.FREE, (*_PRESENT_STATES, *_ACTING_STATES, *_SETTLED_STATES)),
    # An agent may end a task only while it holds the task's lease.
    Row(_V.LATE, _INACTIVE_STATES, None, (_E.WANT,)),
    Row(_V.LATE, _ACTING_STATES, _S.FENCED, (_E.STOP, _E.WANT)),
    Row(_V.LATE, _SETTLED_STATES),
    Row(_V.EXPIRED, _INACTIVE_STATES, _S.RELEASING, (_E.FAIL,)),
    Row(_V.EXPIRED, _ACTING_STATES, _S.RELEASING, (_E.STOP, _E.FAIL)),
    Row(_V.EXPIRED, _SETTLED_STATES),
    Row(_V.BLIND, _PRESENT_STATES, _S.OBSERVING, (_E.RELEASE, _E.HOLD)),
    Row(_V.BLIND, _ACTING_STATES, _S.OBSERVING, (*_GIVE_BACK_EFFECTS, _E.HOLD)),
    Row(_V.BLIND, (_S.IDLE, *_SETTLED_STATES)),
    Row(_V.UNDECIDED, _PRESENT_STATES, _S.REPORTED, (_E.RELEASE, _E.HOLD)),
    Row(_V.UNDECIDED, _ACTING_STATES, _S.REPORTED, (*_GIVE_BACK_EFFECTS, _E.HOLD)),
    Row(_V.UNDECIDED, (_S.IDLE, *_SETTLED_STATES)),
    # A standby without a lease keeps its rank.
    Row(_V.PASSED_OVER, _WAITING_STATES, _S.WAITING, _STAND_BY_EFFECTS),
    Row(_V.PASSED_OVER, (_S.CLAIMING,), _S.WAITING, (_E.RELEASE, *_STAND_BY_EFFECTS)),
    Row(_V.PASSED_OVER, _ACTING_STATES, _S.WAITING, (*_GIVE_BACK_EFFECTS, *_STAND_BY_EFFECTS)),
    Row(_V.PASSED_OVER, (_S.IDLE, *_SETTLED_STATES)),
    Row(_V.LEASED_IN_VAIN, _PRESENT_STATES, _S.WAITING, (_E.RELEASE, *_STAND_BY_EFFECTS)),
    Row(_V.LEASED_IN_VAIN, _ACTING_STATES, _S.WAITING, (*_GIVE_BACK_EFFECTS, *_STAND_BY_EFFECTS)),
    Row(_V.LEASED_IN_VAIN, (_S.IDLE, *_SETTLED_STATES)),
    Row(_V.NAMED, _WAITING_STATES, _S.CLAIMING, (_E.CLAIM, _E.HOLD)),
    Row(_V.NAMED, (_S.CLAIMING,), None, (_E.INSIST, _E.HOLD)),
    Row(_V.NAMED, _ACTING_STATES, _S.FENCED, (_E.STOP, _E.WANT, _E.HOLD)),
    Row(_V.NAMED, (_S.IDLE, *_SETTLED_STATES)),
    Row(_V.GRANTED, _PRESENT_STATES, _S.EXECUTING, (_E.WANT, _E.START, _E.EXECUTE)),
    Row(_V.GRANTED, _ACTING_STATES, None, (_E.WANT, _E.EXECUTE)),
    Row(_V.GRANTED, (_S.IDLE, *_SETTLED_STATES)),
    # The agent remains the acting agent, so that no other agent is assigned; its robot stands still until it has a
    # lease again.
    Row(_V.MOVE, _ACTING_STATES, None, (_E.STOP, _E.CHANGE_COUNCIL)),
    Row(_V.MOVE, _NOT_ACTING_STATES),
    Row(_V.FINISHED, _ACTING_STATES, _S.RELEASING, (_E.STOP, _E.COMPLETE)),
    Row(_V.FINISHED, _NOT_ACTING_STATES),
    # A standby ignores this event: the robot may have a token from an earlier run of the agent.
    Row(_V.OUTRANKED, _ACTING_STATES, _S.FENCED, (_E.STOP, _E.RELEASE)),
    Row(_V.OUTRANKED, _NOT_ACTING_STATES),
    Row(_V.LENT, _INACTIVE_STATES, None, (_E.RELEASE,)),
    Row(_V.LENT, _ACTING_STATES, _S.FENCED, _GIVE_BACK_EFFECTS),
    Row(_V.LENT, _SETTLED_STATES),
    Row(_V.LEAVE, _NOT_ACTING_STATES, None, (_E.HAND_OVER,)),
    Row(_V.LEAVE, _ACTING_STATES, _S.FENCED, (_E.STOP, _E.HAND_OVER)),
    Row(_V.REOPENED, (_S.RELEASING,), _S.FENCED, (_E.RELEASE,)),
    Row(_V.REOPENED, (*_INACTIVE_STATES, *_ACTING_STATES, _S.DONE)),
    Row(_V.OUTCOME, (*_INACTIVE_STATES, _S.RELEASING), _S.DONE, (_E.END,)),
    Row(_V.OUTCOME, _ACTING_STATES, _S.DONE, (_E.STOP, _E.END)),
    Row(_V.OUTCOME, (_S.DONE,)),
)


def build_table(rows: Iterable[Row]) -> dict[tuple[State, Event], tuple[State, tuple[Effect, ...]]]:
    """Return the table of ``rows``, with one entry for each pair of state and event in them."""
    return {(state, row.event): (row.target or state, row.effects) for row in rows for state in row.states}


TABLE = build_table(ROWS)
"""(state, event) to (next state, effects in order)."""


class StateMachine:
    """The state of one agent in one task; ``rank`` is its rank among the standbys, from 1."""

    def __init__(self) -> None:
        self.state = State.IDLE
        self.rank = 0

    def __str__(self) -> str:
        """Return the state for display."""
        return f"{self.state.name}({self.rank})" if self.state is State.WAITING and self.rank else self.state.name

    def apply(self, event: Event, rank: int | None = None) -> tuple[Effect, ...]:
        """Apply ``event`` and return its effects; ``rank`` is the new rank, if the event gives one."""
        self.state, effects = TABLE[self.state, event]
        if rank is not None:
            self.rank = rank
        return effects
