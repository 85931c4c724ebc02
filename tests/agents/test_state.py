"""Tests of ``agents.state``: the table of an agent's states."""

from __future__ import annotations

from twisted.trial.unittest import SynchronousTestCase

from agents.state import NEXT, Course, IllegalStep, State
from middleware.directory.presence import STATUSES

S = State


def at(state: State) -> Course:
    """A course that stands there."""
    course = Course()
    course.state = state
    return course


class CourseTests(SynchronousTestCase):
    def test_only_a_claim_leads_to_execution(self) -> None:
        """EXECUTING is entered from CLAIMING alone."""
        self.assertEqual([state for state in S if S.EXECUTING in NEXT[state]], [S.CLAIMING])

    def test_execution_ends_with_a_stopped_body(self) -> None:
        """EXECUTING is left to RELEASING and FENCED alone, where the body stands."""
        self.assertEqual(NEXT[S.EXECUTING], {S.RELEASING, S.FENCED})

    def test_the_end_is_the_end(self) -> None:
        """Nothing follows DONE, and everything that does not act can end there."""
        self.assertEqual(NEXT[S.DONE], frozenset())
        self.assertEqual({state for state in S if S.DONE not in NEXT[state]}, {S.EXECUTING, S.DONE})

    def test_illegal_steps_raise(self) -> None:
        """Each step that is not in the table raises and leaves the state as it was."""
        for state in S:
            for goal in S:
                course = at(state)
                if goal is state or goal in NEXT[state]:
                    course.go(goal)
                    self.assertIs(course.state, goal)
                else:
                    self.assertRaises(IllegalStep, course.go, goal)
                    self.assertIs(course.state, state)

    def test_reach_never_acts_on_the_way(self) -> None:
        """A way through several states takes legal steps only, and never one through EXECUTING."""
        for state in set(S) - {S.EXECUTING, S.DONE, S.IDLE}:
            for goal in (S.OBSERVING, S.WAITING, S.REPORTED, S.CLAIMING):
                course = at(state)
                course.reach(goal, rank=2)
                self.assertEqual((course.state, course.rank), (goal, 2))
        for goal in (S.WAITING, S.OBSERVING, S.CLAIMING):
            self.assertRaises(IllegalStep, at(S.EXECUTING).reach, goal)
            self.assertRaises(IllegalStep, at(S.DONE).reach, goal)

    def test_statuses_are_those_of_the_page(self) -> None:
        """Each state shows as one of the coarse statuses, and only EXECUTING as that."""
        self.assertTrue({state.status for state in S} <= set(STATUSES))
        self.assertEqual([state for state in S if state.status == "EXECUTING"], [S.EXECUTING])

    def test_rank_is_shown(self) -> None:
        """Who waits says its place among those that stand by."""
        course = at(S.CONFERRING)
        course.go(S.WAITING, rank=2)
        self.assertEqual(str(course), "WAITING(2)")
        self.assertEqual(str(at(S.CLAIMING)), "CLAIMING")
