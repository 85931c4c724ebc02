"""State: where one agent stands in one task, and which steps lead from there; pure.

The table is the whole law: what is not in it cannot happen.  In particular an agent executes only after it claimed,
and it leaves EXECUTING only through RELEASING or FENCED, where its body is stopped before anything else is done.
"""

from __future__ import annotations

from enum import Enum

from middleware.directory import presence


class State(Enum):
    """The states of one agent in one task; the value is the coarse status that the page shows for it."""

    def __new__(cls, number: int, status: str) -> State:
        """A state of its own for each number, since several share a status."""
        state = object.__new__(cls)
        state._value_ = number
        state.status = status
        return state

    status: str

    IDLE = 0, presence.ASSIGNED
    """The body is not free for this task."""
    OBSERVING = 1, presence.SEARCHING
    """Nothing to report yet."""
    REPORTED = 2, presence.WAITING
    """Waits for the reports of others."""
    CONFERRING = 3, presence.WAITING
    """Decides."""
    WAITING = 4, presence.WAITING
    """Another should act; ``rank`` is the place among those that stand by."""
    CLAIMING = 5, presence.WAITING
    """Should act, and asks the council whether it may."""
    EXECUTING = 6, presence.EXECUTING
    """Acts under a lease."""
    RELEASING = 7, presence.WAITING
    """Has stopped its body and gives the lease back."""
    FENCED = 8, presence.WAITING
    """Has stopped its body because its lease ran out or a newer token was seen."""
    DONE = 9, presence.DONE
    """The task has an outcome."""


_S = State
NEXT: dict[State, frozenset[State]] = {
    _S.IDLE: frozenset({_S.OBSERVING, _S.DONE}),
    _S.OBSERVING: frozenset({_S.REPORTED, _S.IDLE, _S.DONE}),
    _S.REPORTED: frozenset({_S.OBSERVING, _S.CONFERRING, _S.IDLE, _S.DONE}),
    _S.CONFERRING: frozenset({_S.OBSERVING, _S.REPORTED, _S.WAITING, _S.CLAIMING, _S.IDLE, _S.DONE}),
    _S.WAITING: frozenset({_S.OBSERVING, _S.REPORTED, _S.CONFERRING, _S.IDLE, _S.DONE}),
    _S.CLAIMING: frozenset({_S.OBSERVING, _S.REPORTED, _S.CONFERRING, _S.EXECUTING, _S.IDLE, _S.DONE}),
    _S.EXECUTING: frozenset({_S.RELEASING, _S.FENCED}),
    _S.RELEASING: frozenset({_S.OBSERVING, _S.WAITING, _S.IDLE, _S.DONE}),
    _S.FENCED: frozenset({_S.OBSERVING, _S.WAITING, _S.IDLE, _S.DONE}),
    _S.DONE: frozenset(),
}
THROUGH = (_S.REPORTED, _S.CONFERRING, _S.WAITING)


class IllegalStep(AssertionError):
    """A step that the table does not have: a fault of this program, never of a peer."""


class Course:
    """The way of one agent through one task; ``rank`` is its place among those that stand by, from 1."""

    def __init__(self) -> None:
        self.state = State.IDLE
        self.rank = 0

    def __str__(self) -> str:
        """The state as people read it."""
        return f"{self.state.name}({self.rank})" if self.state is State.WAITING and self.rank else self.state.name

    def go(self, *states: State, rank: int = 0) -> None:
        """Take these steps; a step to where it stands already is none.  Raises ``IllegalStep``."""
        for state in states:
            if state is not self.state:
                if state not in NEXT[self.state]:
                    raise IllegalStep(f"no step leads from {self.state.name} to {state.name}")
                self.state = state
        self.rank = rank

    def reach(self, goal: State, rank: int = 0) -> None:
        """Go to ``goal`` through the states of who neither acts nor stops acting.  Raises ``IllegalStep``."""
        ways: list[tuple[State, ...]] = [()]
        while ways:
            way = ways.pop(0)
            at = way[-1] if way else self.state
            if at is goal:
                return self.go(*way, rank=rank)
            ways += [(*way, state) for state in THROUGH if state in NEXT[at] and state not in (*way, self.state)]
            if goal in NEXT[at] and goal not in THROUGH:
                return self.go(*way, goal, rank=rank)
        raise IllegalStep(f"no way leads from {self.state.name} to {goal.name}")
