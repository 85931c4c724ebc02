"""The states of a lease client, and its transition table; pure.

The client (``lease_client``) converts calls, timers and the results of rounds into events, looks up the transition for
each event, and performs the actions of the transition.  The states of a claim are PREPARING, then PROMISED if the
previous lease has not ended, then PROPOSING, then HOLDING.  A standby alternates between WATCHING and LOOKING until the
lease is about to end.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import Enum
from typing import NamedTuple


class State(Enum):
    """A state of the client; the value describes it."""

    IDLE = "does not want the lease"
    WATCHING = "waits, and then asks when the lease ends"
    LOOKING = "asks when the lease ends"
    WAITING = "waits, and then claims"
    PREPARING = "asks the council for promises"
    PROMISED = "has the promises of a majority, and waits for the end of the previous lease"
    PROPOSING = "asks the council to grant or renew the lease"
    COMPLETING = "completes a change of the council that another proposer began"
    HOLDING = "holds the lease"
    OUTBID = "holds the lease, and needs a new ballot to renew it"
    OVER = "knows that the task has ended"


class Event(Enum):
    """An input of the client; the value describes it."""

    WANT = "the agent wants the lease"
    STAND_BY = "the agent wants the lease when its holder loses it"
    RANK = "the agent's rank among the standbys changed while the lease is not held"
    SUSPECT = "the holder may have failed"
    FREED = "the holder released the lease"
    OUTRANK = "the device obeyed a higher token"
    RELEASE = "the agent releases the lease or stops claiming it"
    MOVE = "the agent changes the council"
    MOVED = "the change of the council has ended"
    DUE = "the timer fired"
    DUE_FREED = "the timer fired soon after the lease was released"
    EXPIRED = "the timer fired after the deadline of the client's lease"
    NEAR = "the lease ends soon"
    FAR = "the end of the lease is far off or unknown"
    FREE = "a majority replies that the lease is free"
    TAKEN = "no majority replies that the lease is free"
    RECONFIGURED = "a member reported a newer council"
    PROMISES = "a majority promised, and the lease is free"
    EARLY_PROMISES = "a majority promised before the end of the previous lease"
    UNFINISHED = "a majority promised, and a member had accepted a change of the council"
    COMPLETED = "that change is complete"
    GRANTS = "a majority granted the lease, and no member needs another ballot"
    PARTIAL_GRANTS = "a majority granted the lease, and some member needs another ballot"
    KEPT = "the round failed, and the client's lease is valid"
    OUTBID = "the round failed because of a higher ballot, and the client's lease is valid"
    REJECTED = "the round failed, and the client has no lease"
    ENDED = "a majority replies that the task has ended"


class Action(Enum):
    """An action at a transition; the value describes it."""

    CANCEL = "cancel the round and the timer"
    LOOK = "ask when the lease ends"
    PREPARE = "ask for promises under a new ballot"
    PROPOSE = "ask for the lease under the promised ballot"
    RENEW = "ask for the lease again under the ballot that it was granted under"
    COMPLETE = "complete the change of the council"
    LEAP = "choose the next ballot above those of other standbys"
    LOSE = "forget the lease, and notify the agent"
    DROP = "release a claim that only a minority granted, and forget the lease"
    NOTIFY = "notify the agent of the granted lease"
    LINE_UP = "estimate the end of the lease, which leads to the event NEAR or FAR"
    AFTER_RANK = "set the timer for the first poll, later for higher ranks"
    AFTER_POLL = "set the timer for the next poll"
    AFTER_WAIT = "set the timer for the claim at the end of the lease"
    AFTER_TURN = "set the timer for the claim of a released lease"
    AFTER_PREVIOUS = "set the timer for the end of the previous lease"
    AFTER_RENEWAL = "set the timer for the renewal"
    AFTER_RETRY = "set the timer for a retry before the deadline"
    AFTER_BACK_OFF = "set the timer for a random back-off"


class Step(NamedTuple):
    """A transition: the next state, and the actions in the order in which they are performed."""

    state: State
    actions: tuple[Action, ...] = ()


S, E, A = State, Event, Action

_CLAIM = Step(S.PREPARING, (A.PREPARE,))
_RECLAIM = Step(S.PREPARING, (A.LOSE, A.PREPARE))
_IDLE = Step(S.IDLE, (A.CANCEL,))
_ENDED = Step(S.OVER, (A.CANCEL, A.LOSE))
_PAUSED = Step(S.WAITING, (A.CANCEL,))
_LINE_UP = Step(S.WAITING, (A.LINE_UP,))
_TURN = Step(S.WAITING, (A.LEAP, A.AFTER_TURN))
_FAILED: Mapping[Event, Step] = {
    E.KEPT: Step(S.HOLDING, (A.AFTER_RETRY,)),
    E.OUTBID: Step(S.OUTBID, (A.AFTER_RETRY,)),
    E.REJECTED: Step(S.WAITING, (A.DROP, A.LINE_UP)),
    E.ENDED: _ENDED,
}
_ALWAYS: Mapping[Event, Step] = {E.RELEASE: _IDLE, E.OUTRANK: _RECLAIM, E.MOVE: _PAUSED}

TABLE: Mapping[State, Mapping[Event, Step]] = {
    S.IDLE: {E.WANT: _CLAIM, E.STAND_BY: Step(S.WATCHING, (A.AFTER_RANK,)), E.RELEASE: _IDLE},
    S.WATCHING: {
        **_ALWAYS,
        E.DUE: Step(S.LOOKING, (A.LOOK,)),
        E.DUE_FREED: _CLAIM,
        E.EXPIRED: Step(S.LOOKING, (A.LOSE, A.LOOK)),
        E.SUSPECT: Step(S.LOOKING, (A.LOOK,)),
        E.FREED: _TURN,
        E.MOVE: Step(S.WATCHING, (A.CANCEL,)),
        E.MOVED: _CLAIM,
        E.COMPLETED: Step(S.WATCHING, (A.AFTER_BACK_OFF,)),
    },
    S.LOOKING: {
        **_ALWAYS,
        E.FREE: _CLAIM,
        E.TAKEN: _LINE_UP,
        E.RECONFIGURED: Step(S.LOOKING, (A.LOOK,)),
        E.FREED: Step(S.WAITING, (A.LEAP, A.CANCEL, A.AFTER_TURN)),
        E.MOVE: Step(S.WATCHING, (A.CANCEL,)),
        E.ENDED: _ENDED,
    },
    S.WAITING: {
        **_ALWAYS,
        E.DUE: _CLAIM,
        E.DUE_FREED: _CLAIM,
        E.EXPIRED: _RECLAIM,
        E.NEAR: Step(S.WAITING, (A.AFTER_WAIT,)),
        E.FAR: Step(S.WATCHING, (A.AFTER_POLL,)),
        E.RANK: _LINE_UP,
        E.FREED: _TURN,
        E.MOVED: _CLAIM,
        E.COMPLETED: Step(S.WAITING, (A.AFTER_BACK_OFF,)),
    },
    S.PREPARING: {
        **_ALWAYS,
        **_FAILED,
        E.PROMISES: Step(S.PROPOSING, (A.PROPOSE,)),
        E.EARLY_PROMISES: Step(S.PROMISED, (A.AFTER_PREVIOUS,)),
        E.UNFINISHED: Step(S.COMPLETING, (A.COMPLETE,)),
        E.RECONFIGURED: _CLAIM,
        E.FREED: Step(S.PREPARING, (A.LEAP,)),
    },
    S.PROMISED: {**_ALWAYS, E.DUE: Step(S.PROPOSING, (A.PROPOSE,)), E.FREED: Step(S.PROMISED, (A.LEAP,))},
    S.PROPOSING: {
        **_ALWAYS,
        **_FAILED,
        E.GRANTS: Step(S.HOLDING, (A.AFTER_RENEWAL, A.NOTIFY)),
        E.PARTIAL_GRANTS: Step(S.OUTBID, (A.AFTER_RENEWAL, A.NOTIFY)),
        E.FREED: Step(S.PROPOSING, (A.LEAP,)),
    },
    S.COMPLETING: {
        **_ALWAYS,
        E.COMPLETED: Step(S.WAITING, (A.AFTER_BACK_OFF,)),
        E.RANK: _LINE_UP,
        E.FREED: _TURN,
        E.MOVED: _CLAIM,
    },
    S.HOLDING: {
        **_ALWAYS,
        E.DUE: Step(S.PROPOSING, (A.RENEW,)),
        E.EXPIRED: _RECLAIM,
        E.FREED: Step(S.HOLDING, (A.LEAP, A.AFTER_TURN)),
        E.MOVED: _CLAIM,
        E.COMPLETED: Step(S.HOLDING, (A.AFTER_BACK_OFF,)),
    },
    S.OUTBID: {
        **_ALWAYS,
        E.DUE: _CLAIM,
        E.EXPIRED: _RECLAIM,
        E.FREED: Step(S.OUTBID, (A.LEAP, A.AFTER_TURN)),
        E.MOVED: _CLAIM,
        E.COMPLETED: Step(S.OUTBID, (A.AFTER_BACK_OFF,)),
    },
    S.OVER: {E.RELEASE: Step(S.OVER, (A.CANCEL,))},
}
"""The transitions.  A pair of state and event that is neither here nor in ``IMPOSSIBLE`` has no effect."""

TIMED = (S.WATCHING, S.WAITING, S.PROMISED, S.HOLDING, S.OUTBID)
"""States in which a timer runs, except while the council changes (between the events MOVE and MOVED)."""
ASKING = (S.LOOKING, S.PREPARING, S.PROPOSING)
"""States in which a round is running."""
ACTIVE = tuple(state for state in State if state not in (S.IDLE, S.OVER))
"""States in which the agent wants the lease."""
_OF_TIMERS = (E.DUE, E.DUE_FREED, E.EXPIRED)
_OF_ROUNDS = {
    S.LOOKING: (E.FREE, E.TAKEN, E.RECONFIGURED, E.ENDED),
    S.PREPARING: (*_FAILED, E.PROMISES, E.EARLY_PROMISES, E.UNFINISHED, E.RECONFIGURED),
    S.PROPOSING: (*_FAILED, E.GRANTS, E.PARTIAL_GRANTS),
}
_LISTED = {event for events in _OF_ROUNDS.values() for event in events}

IMPOSSIBLE: frozenset[tuple[State, Event]] = frozenset(
    [
        *((state, event) for state in State if state not in TIMED for event in _OF_TIMERS),
        *((state, event) for state in State for event in _LISTED if event not in _OF_ROUNDS.get(state, ())),
        *((state, event) for state in State if state is not S.WAITING for event in (E.NEAR, E.FAR)),
        *((S.PROMISED, event) for event in (E.DUE_FREED, E.EXPIRED)),
        *((state, E.DUE_FREED) for state in (S.HOLDING, S.OUTBID)),
    ]
)
"""Pairs that cannot occur, for example the result of a round in a state without a running round."""


def next_step(state: State, event: Event) -> Step:
    """Return the transition of ``event`` in ``state``; an event without effect leads to ``state`` itself.

    :raises ValueError: for a pair that is in ``IMPOSSIBLE``
    """
    if (state, event) in IMPOSSIBLE:
        raise ValueError(f"{event.name} cannot happen while a lease client is {state.name}")
    return TABLE[state].get(event, Step(state))
