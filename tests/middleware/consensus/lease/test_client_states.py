"""Tests of ``middleware.consensus.lease.client_states``."""

from __future__ import annotations

from collections import deque
from pathlib import Path

from twisted.trial.unittest import SynchronousTestCase

from middleware.consensus.lease.client_states import (
    ACTIVE,
    ASKING,
    IMPOSSIBLE,
    TABLE,
    TIMED,
    Action,
    Event,
    State,
    next_step,
)
from tests.middleware.consensus.lease.state_table import write_states

TIMERS = {action for action in Action if action.name.startswith("AFTER_")} | {Action.LINE_UP}
QUESTIONS = {
    State.LOOKING: {Action.LOOK},
    State.PREPARING: {Action.PREPARE},
    State.PROPOSING: {Action.PROPOSE, Action.RENEW},
}
GRANTED = (Event.GRANTS, Event.PARTIAL_GRANTS)
OWN = (Event.KEPT, Event.OUTBID)
"""Events that occur only while the client's lease is valid."""


def explore() -> dict[tuple[State, bool], tuple[Event, ...]]:
    """Return each reachable state, with and without a granted lease, and the events of a shortest path to it."""
    begin = (State.IDLE, False)
    found: dict[tuple[State, bool], tuple[Event, ...]] = {begin: ()}
    left = deque([begin])
    while left:
        state, is_granted = left.popleft()
        for event in Event:
            if (state, event) in IMPOSSIBLE or (event in OWN and not is_granted):
                continue
            target, actions = next_step(state, event)
            after = target, _is_granted(is_granted, event, actions)
            if after not in found:
                found[after] = (*found[state, is_granted], event)
                left.append(after)
    return found


def _is_granted(before: bool, event: Event, actions: tuple[Action, ...]) -> bool:
    is_lost = event in (Event.RELEASE, Event.MOVE) or bool({Action.LOSE, Action.DROP} & set(actions))
    return event in GRANTED or (before and not is_lost)


class ClientStatesTests(SynchronousTestCase):
    """Tests that the table is complete, and that no path through the states violates a rule of leases."""

    def test_every_pair_is_decided(self) -> None:
        """Each pair of state and event has a transition, is ignored, or is impossible."""
        pairs = {(state, event) for state in State for event in Event}
        transitions = {(state, event) for state, row in TABLE.items() for event in row}
        self.assertEqual(set(TABLE), set(State))
        self.assertEqual(transitions & IMPOSSIBLE, set())
        for state, event in pairs - transitions - IMPOSSIBLE:
            self.assertEqual(next_step(state, event), (state, ()))
        for state, event in IMPOSSIBLE:
            self.assertRaises(ValueError, next_step, state, event)

    def test_every_state_is_reached(self) -> None:
        """A path leads from IDLE to each state."""
        self.assertEqual({state for state, _ in explore()}, set(State))

    def test_only_a_majority_grants(self) -> None:
        """Each path to a state in which the client has the lease contains the grants of a majority."""
        for (state, is_granted), path in explore().items():
            if state in (State.HOLDING, State.OUTBID):
                self.assertTrue(is_granted, (state, path))
                self.assertTrue(set(GRANTED) & set(path), (state, path))

    def test_release_ends_every_claim(self) -> None:
        """In each state RELEASE cancels the round and the timer and leads to IDLE; only OVER stays OVER."""
        for state, _ in explore():
            target, actions = next_step(state, Event.RELEASE)
            self.assertEqual(target, State.OVER if state is State.OVER else State.IDLE)
            self.assertIn(Action.CANCEL, actions)
        for event in Event:
            if (State.OVER, event) not in IMPOSSIBLE:
                self.assertEqual(next_step(State.OVER, event).state, State.OVER)

    def test_nothing_is_asked_in_vain(self) -> None:
        """Each transition to a state that waits for replies sends the request for them.

        Each transition to a state with a timer starts this timer, unless the event is MOVE.
        """
        for state, row in TABLE.items():
            for event, (target, actions) in row.items():
                entered = target is not state or event in (Event.RECONFIGURED, Event.OUTRANK)
                if target in ASKING and entered:
                    self.assertTrue(QUESTIONS[target] & set(actions), (state, event))
                elif target in TIMED and event is not Event.MOVE and (target is not state or event is Event.COMPLETED):
                    self.assertTrue(TIMERS & set(actions), (state, event))

    def test_a_client_goes_on(self) -> None:
        """From each active state at least one path leads to the state HOLDING."""
        for begin in ACTIVE:
            found: set[State] = {begin}
            left: list[State] = [begin]
            while left:
                state = left.pop()
                steps = [next_step(state, event).state for event in Event if (state, event) not in IMPOSSIBLE]
                left += (new := set(steps) - found)
                found |= new
            self.assertIn(State.HOLDING, found, begin)

    def test_page_has_the_table(self) -> None:
        """The states in docs/explanation/choosing-a-robot.md match the code."""
        page = Path(__file__).parents[4] / "docs" / "explanation" / "choosing-a-robot.md"
        self.assertIn(write_states(), page.read_text(encoding="utf-8"))
