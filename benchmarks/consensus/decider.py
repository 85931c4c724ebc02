"""The strategies as functions from bids to the owner of each task, with their communication cost."""

from __future__ import annotations

from collections.abc import Callable

from benchmarks.consensus.mission import Mission
from middleware.consensus.item import Sharing, capacities, exact
from middleware.consensus.strategies.cbba import Cbba, greedy
from middleware.consensus.strategies.group_optimal import BIDS, GroupOptimal
from middleware.consensus.strategies.nearest import Nearest
from middleware.consensus.strategies.sequential import Sequential
from middleware.consensus.strategy import Consensus, Report

Owners = dict[str, str]
Decider = Callable[[Mission, list[Report]], Owners]


def in_order(mission: Mission, reports: list[Report]) -> Owners:
    """The rule of the thesis: one task after the other; an agent with a full bundle does not bid."""
    left = capacities(reports)
    owners: Owners = {}
    bids: dict[str, list[Report]] = {}
    for report in reports:
        bids.setdefault(report.task, []).append(report)
    for task in mission.places:
        free = [r for r in bids.get(task, ()) if left[r.agent] > 0]
        chosen = Nearest().find(free).assigned_agent
        if chosen is not None:
            owners[task] = chosen
            left[chosen] -= 1
    return owners


def bundled(mission: Mission, reports: list[Report]) -> Owners:
    """CBBA without exchange, which ends at the greedy assignment."""
    costs: dict[str, dict[str, float]] = {}
    for report in reports:
        costs.setdefault(report.agent, {})[report.task] = exact(report.cost)
    return greedy(costs, capacities(reports))


def shared(strategy: Sharing) -> Decider:
    """Return the function of a strategy for several tasks."""

    def decide(mission: Mission, reports: list[Report]) -> Owners:
        points: tuple[Consensus, ...] = strategy.find_group(reports, mission.items)
        return {point.task: point.assigned_agent for point in points if point.assigned_agent is not None}

    return decide


def with_all_bids() -> GroupOptimal:
    """The optimum over all bids, instead of 20 of each agent."""
    strategy = GroupOptimal()
    strategy.bids = 10**6
    return strategy


MEETINGS = "cbba, then meetings"
TALKED = ("cbba", MEETINGS)
FEWER = f"group_optimal, {BIDS} bids"
DECIDERS: dict[str, Decider] = {
    "nearest, in order": in_order,
    "cbba": bundled,
    MEETINGS: bundled,
    "cbba + exchange": shared(Cbba()),
    "sequential": shared(Sequential()),
    FEWER: shared(GroupOptimal()),
    "group_optimal": shared(with_all_bids()),
}
NAMED = {FEWER: BIDS}
"""Bids of each agent, if the number does not depend on the team."""
