"""The strategies as functions from bids to the owner of each task, with their communication cost."""

from __future__ import annotations

from collections.abc import Callable

from benchmarks.consensus.mission import Mission
from middleware.consensus.assignment import MultiTaskStrategy, find_capacities, to_millionths
from middleware.consensus.strategies.cbba import Cbba, assign_greedily
from middleware.consensus.strategies.group_optimal import FIRST_PASS_BIDS, GroupOptimal
from middleware.consensus.strategies.nearest import Nearest
from middleware.consensus.strategies.sequential import Sequential
from middleware.consensus.strategy import Consensus, Report

Owners = dict[str, str]
Decider = Callable[[Mission, list[Report]], Owners]


def decide_in_order(mission: Mission, reports: list[Report]) -> Owners:
    """Decide by the rule of the thesis: one task after the other; an agent with a full bundle does not bid."""
    left = find_capacities(reports)
    owners: Owners = {}
    bids: dict[str, list[Report]] = {}
    for report in reports:
        bids.setdefault(report.task, []).append(report)
    for task in mission.task_positions:
        free = [r for r in bids.get(task, ()) if left[r.agent] > 0]
        chosen = Nearest().find(free).assigned_agent
        if chosen is not None:
            owners[task] = chosen
            left[chosen] -= 1
    return owners


def decide_greedily(mission: Mission, reports: list[Report]) -> Owners:
    """Decide like CBBA without exchanges, which results in the greedy assignment."""
    costs: dict[str, dict[str, float]] = {}
    for report in reports:
        costs.setdefault(report.agent, {})[report.task] = to_millionths(report.cost)
    return assign_greedily(costs, find_capacities(reports))


def make_decider(strategy: MultiTaskStrategy) -> Decider:
    """Return the function of a strategy for several tasks."""

    def decide(mission: Mission, reports: list[Report]) -> Owners:
        points: tuple[Consensus, ...] = strategy.find_group(reports, mission.items)
        return {point.task: point.assigned_agent for point in points if point.assigned_agent is not None}

    return decide


def make_exact_optimum() -> GroupOptimal:
    """Return the optimum over all bids, instead of 20 bids of each agent."""
    strategy = GroupOptimal()
    strategy.bids = 10**6
    return strategy


MEETINGS = "cbba, then meetings"
EXCHANGING = ("cbba", MEETINGS)
LIMITED_OPTIMUM = f"group_optimal, {FIRST_PASS_BIDS} bids"
DECIDERS: dict[str, Decider] = {
    "nearest, in order": decide_in_order,
    "cbba": decide_greedily,
    MEETINGS: decide_greedily,
    "cbba + exchange": make_decider(Cbba()),
    "sequential": make_decider(Sequential()),
    LIMITED_OPTIMUM: make_decider(GroupOptimal()),
    "group_optimal": make_decider(make_exact_optimum()),
}
BIDS_BY_NAME = {LIMITED_OPTIMUM: FIRST_PASS_BIDS}
"""Number of bids of each agent, for strategies for which this number is fixed."""
