"""Strategy ``cbba``: the result of the consensus-based bundle algorithm (CBBA), computed from all reports.

Choi, Brunet, How, IEEE Transactions on Robotics 25(4), 2009.  The distributed algorithm
(``benchmarks.consensus.bidder``) converges to the sequential greedy assignment; here that assignment is computed
directly, and is then improved by moves and swaps of tasks.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence

from middleware.consensus.assignment import (
    Item,
    MultiTaskStrategy,
    build_decisions,
    find_capacities,
    sort_items,
    to_millionths,
)
from middleware.consensus.strategy import Consensus, Report, standing

MAX_SWEEPS = 50
"""Maximum number of passes over an assignment with moves and swaps."""


class Cbba(MultiTaskStrategy):
    """The sequential greedy assignment, improved by moves and swaps; a single task is assigned to the nearest agent."""

    name = "cbba"
    version = "1"

    def find_group(self, contacts: Sequence[Report], items: Sequence[Item]) -> tuple[Consensus, ...]:
        """Return one decision for each item, sorted by task id, each with one agent."""
        items = sort_items(items)
        wanted = {item.task for item in items}
        counted = [r for r in standing(contacts) if r.task in wanted]
        capacity_left = find_capacities(counted)
        costs: dict[str, dict[str, int]] = {agent: {} for agent in capacity_left}
        for report in counted:
            costs[report.agent][report.task] = to_millionths(report.cost)
        owners = improve_assignment(assign_greedily(costs, capacity_left), costs, capacity_left)
        return build_decisions(self.name, counted, items, {task: [agent] for task, agent in owners.items()})


def assign_greedily(costs: Mapping[str, Mapping[str, float]], capacities: Mapping[str, int]) -> dict[str, str]:
    """Return the agent of each task: repeatedly assign the cheapest remaining pair; ties are broken by id."""
    capacity_left = dict(capacities)
    owner: dict[str, str] = {}
    pairs: Iterable[tuple[float, str, str]] = sorted((c, a, t) for a, row in costs.items() for t, c in row.items())
    for _, agent, task in pairs:
        if task not in owner and capacity_left.get(agent, 1) > 0:
            owner[task] = agent
            capacity_left[agent] = capacity_left.get(agent, 1) - 1
    return owner


def improve_assignment(
    owners: Mapping[str, str], costs: Mapping[str, Mapping[str, int]], capacities: Mapping[str, int]
) -> dict[str, str]:
    """Improve an assignment: move tasks to other agents and swap pairs of tasks as long as this lowers the total cost.

    ``costs`` maps agent and task to the cost; a task is assigned only to agents with a cost for it.  The result is much
    closer to an optimal assignment than the greedy one.
    """
    owner = dict(sorted(owners.items()))
    task_counts = Counter(owner.values())
    capacity_left = {agent: capacities.get(agent, 1) - task_counts[agent] for agent in costs}
    free = {agent for agent, places in capacity_left.items() if places > 0}
    known = {agent: sorted(costs[agent].keys() & owner.keys()) for agent in costs}
    for _ in range(MAX_SWEEPS):
        changed = [
            _move_task(task, owner, costs, capacity_left, free) | _swap_task(task, owner, costs, known)
            for task in owner
        ]
        if not any(changed):
            break
    return owner


def _move_task(
    task: str,
    owner: dict[str, str],
    costs: Mapping[str, Mapping[str, int]],
    capacity_left: dict[str, int],
    free: set[str],
) -> bool:
    """Assign the task to the cheapest of the agents with remaining capacity (``free``), if that lowers the cost."""
    offers = [(costs[agent][task], agent) for agent in free if task in costs[agent]]
    now = owner[task]
    if not offers or min(offers)[0] >= costs[now][task]:
        return False
    then = min(offers)[1]
    owner[task] = then
    for agent, more in ((now, 1), (then, -1)):
        capacity_left[agent] += more
        (free.add if capacity_left[agent] > 0 else free.discard)(agent)
    return True


def _swap_task(
    task: str, owner: dict[str, str], costs: Mapping[str, Mapping[str, int]], known: Mapping[str, list[str]]
) -> bool:
    """Swap the task for the one that lowers the total cost most.

    ``known`` contains the tasks that each agent bid for.
    """
    own_agent = owner[task]
    row = costs[own_agent]
    least, best = 0, ""
    for other in known[own_agent]:
        other_agent = owner[other]
        if other_agent != own_agent and task in costs[other_agent]:
            gain = row[other] + costs[other_agent][task] - row[task] - costs[other_agent][other]
            if gain < least:
                least, best = gain, other
    if not best:
        return False
    owner[task], owner[best] = owner[best], own_agent
    return True
