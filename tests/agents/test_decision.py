"""Tests of ``agents.decision``: the assignment of an agent from all reports."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st
from twisted.trial.unittest import SynchronousTestCase

from agents.decision import Decision, decide
from middleware.consensus.bidding.reporters import ANNOUNCEMENT_TIMEOUT_S
from middleware.consensus.guarded_strategy import GuardedStrategy
from middleware.consensus.strategies.nearest import Nearest
from middleware.consensus.strategy import load_strategy
from middleware.directory.presence import EXECUTING, SEARCHING, WAITING
from middleware.tasks.task import Member


def member(uuid: str, cost: float | None, status: str = WAITING) -> Member:
    """Return a report."""
    return Member(uuid, f"dog-{uuid}", status, cost)


def decided(*members: Member, since: float | None = 100.0, hysteresis: float = 0.1) -> Decision:
    """Return the decision on these reports with a waiting period of 8 s."""
    return decide(members, Nearest(), hysteresis, 8.0, since)


REPORTS = st.lists(
    st.tuples(
        st.integers(0, 9),
        st.none() | st.floats(0.0, 9.0),
        st.sampled_from((SEARCHING, WAITING, EXECUTING)),
    ),
    max_size=6,
    unique_by=lambda entry: entry[0],
)


def by(strategy: str, *members: Member) -> Decision:
    """Return the decision of the strategy ``name``, long after the waiting period."""
    return decide(members, GuardedStrategy(load_strategy(strategy)), 0.1, 8.0, 100.0)


class ReadingTests(SynchronousTestCase):
    """Strategies that use reported values in addition to the cost."""

    def test_charged_one_is_preferred(self) -> None:
        """Of equally distant robots, the robot with more battery charge is assigned.

        At equal charge, the robot with fewer tasks is assigned.
        """
        low, full = replace(member("a", 5.0), battery=0.2), replace(member("b", 5.0), battery=0.9)
        self.assertEqual(by("capability_cost", low, full).assigned, "b")
        self.assertEqual(by("nearest", low, full).assigned, "a")
        busy, free = replace(member("a", 5.0), load=2), replace(member("b", 5.0), load=1)
        self.assertEqual(by("capability_cost", busy, free).assigned, "b")

    def test_vote_decides(self) -> None:
        """The option with the largest total weight wins, and of its voters the one with the lowest cost is assigned."""
        one, two = replace(member("a", 1.0), choice="red"), replace(member("b", 2.0), choice="blue")
        three = replace(member("c", 3.0), choice="blue")
        decision = by("weighted_vote", one, two, three)
        self.assertEqual((decision.assigned, decision.consensus and decision.consensus.choice), ("b", "blue"))
        self.assertEqual(decision.why, "dog-b, 2.00, best of 3; agreed on blue")
        self.assertEqual(by("weighted_vote", replace(one, weight=9.0), two, three).assigned, "a")


class DecisionTests(SynchronousTestCase):
    def test_nearest_of_all_is_assigned(self) -> None:
        """If all agents have reported, the nearest is assigned before the end of the waiting period."""
        decision = decided(member("a", 2.0), member("b", 1.0), member("c", 3.0), since=0.0)
        self.assertEqual(decision.assigned, "b")
        self.assertEqual(decision.why, "dog-b, 1.00, best of 3")

    def test_waiting_period_holds_for_those_who_are_missing(self) -> None:
        """During the waiting period no agent is assigned if a report is missing.

        The reason lists the missing agents.
        """
        members = member("a", 2.0), member("c", None, SEARCHING), member("b", None, SEARCHING)
        early = decided(*members, since=7.9)
        self.assertEqual((early.assigned, early.why), (None, "waiting for dog-b, dog-c"))
        self.assertEqual(decided(*members, since=8.0).assigned, "a")

    def test_nobody_goes_without_a_report(self) -> None:
        """Without any report no agent is ever assigned."""
        for members in ([], [member("a", None)]):
            decision = decided(*members, since=None)
            self.assertEqual((decision.assigned, decision.why), (None, "no agent has reported yet"))

    def test_acting_member_keeps_the_task_within_the_hysteresis(self) -> None:
        """The acting agent keeps the task unless another agent's cost is lower by at least the hysteresis."""
        acting = member("z", 1.0, EXECUTING)
        for cost, assigned in ((0.95, "z"), (0.90, "z"), (0.89, "a")):
            self.assertEqual(decided(acting, member("a", cost)).assigned, assigned, cost)

    def test_acting_member_is_not_stopped_by_a_missing_report(self) -> None:
        """The acting agent keeps the task when a new member has not reported yet."""
        decision = decided(member("z", 1.0, EXECUTING), member("a", None, SEARCHING), since=0.0)
        self.assertEqual(decision.assigned, "z")

    def test_acting_member_with_an_unlawful_report_gives_way(self) -> None:
        """An acting agent with an invalid or too large cost loses the task to an agent with a valid cost."""
        nonsense: list[Any] = [10**400, float("inf"), float("nan"), -1.0, True, "1", 1e300]
        for cost in nonsense:
            self.assertIsNone(decided(member("z", cost, EXECUTING)).assigned)
        for cost in (*nonsense, 2e9):
            for hysteresis in (0.1, 1.0):
                decision = decided(member("z", cost, EXECUTING), member("a", 5.0), hysteresis=hysteresis)
                self.assertEqual(decision.assigned, "a", (cost, hysteresis))

    def test_two_acting_members_come_down_to_one(self) -> None:
        """If two agents report that they act, all agents choose the one with the lower cost, then the lower uuid."""
        self.assertEqual(decided(member("a", 1.02, EXECUTING), member("b", 1.0, EXECUTING)).assigned, "b")
        self.assertEqual(decided(member("b", 1.0, EXECUTING), member("a", 1.0, EXECUTING)).assigned, "a")

    @settings(max_examples=60)
    @given(REPORTS, st.floats(0.0, 20.0), st.randoms(use_true_random=False))
    def test_order_of_members_does_not_matter(
        self, entries: list[tuple[int, float | None, str]], since: float, rng: object
    ) -> None:
        """Agents that receive the same reports in different orders reach the same decision with the same reason."""
        members = [member(f"{number:x}", cost, status) for number, cost, status in entries]
        shuffled = list(members)
        rng.shuffle(shuffled)  # type: ignore[attr-defined]
        self.assertEqual(decided(*members, since=since), decided(*shuffled, since=since))

    @settings(max_examples=60)
    @given(REPORTS)
    def test_assigned_agent_has_reported_and_is_good_enough(self, entries: list[tuple[int, float | None, str]]) -> None:
        """After the waiting period an agent with a report is assigned.

        No agent is better than it by more than the hysteresis.
        """
        members = [member(f"{number:x}", cost, status) for number, cost, status in entries]
        costs = {m.uuid: m.cost for m in members if m.cost is not None}
        decision = decided(*members)
        if not costs:
            self.assertIsNone(decision.assigned)
            return
        assert decision.assigned is not None
        chosen = costs[decision.assigned]
        self.assertTrue(chosen == min(costs.values()) or min(costs.values()) >= chosen * 0.9)


class ReportersTests(SynchronousTestCase):
    """Decisions from the reports of a subset of the agents (the reporters)."""

    def panelled(self, since: float, has_word: bool, *members: Member) -> str | None:
        """Return the agent that is assigned according to these reports.

        ``has_word`` is true if the council has announced the bids that it received.
        """
        return decide(members, Nearest(), 0.1, 8.0, since, has_word).assigned

    def test_council_is_waited_for(self) -> None:
        """If all reporters have reported, the decision still waits for the council's announcement or a timeout."""
        reporters = member("a", 2.0), member("b", 1.0)
        self.assertIsNone(self.panelled(0.0, False, *reporters))
        self.assertIsNone(self.panelled(8.0 + ANNOUNCEMENT_TIMEOUT_S - 0.1, False, *reporters))
        self.assertEqual(self.panelled(8.0 + ANNOUNCEMENT_TIMEOUT_S, False, *reporters), "b")

    def test_word_of_the_council_decides(self) -> None:
        """After the council's announcement, or while an agent acts, the decision does not wait for missing reports."""
        reporters = member("a", 2.0), member("b", 1.0), member("c", None)
        self.assertEqual(self.panelled(0.0, True, *reporters), "b")
        self.assertEqual(self.panelled(0.0, False, member("a", 1.0, EXECUTING), *reporters[1:]), "a")
