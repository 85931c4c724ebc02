"""Strategy ``group_optimal``: assign several tasks so that the total cost is minimal.

In the first pass only the cheapest tasks of each agent are considered.  If tasks remain without an agent, the
assignment is computed again, with all reports for these tasks.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from middleware.consensus.assignment import (
    Item,
    MultiTaskStrategy,
    build_decisions,
    find_capacities,
    sort_items,
    to_millionths,
)
from middleware.consensus.strategies import hungarian
from middleware.consensus.strategy import Consensus, Report, standing

FIRST_PASS_BIDS = 20
"""Number of bids per agent in the first pass.  So many bids fit into one datagram, and the cost is about 1 % above the
optimum.
"""


class GroupOptimal(MultiTaskStrategy):
    """The cheapest assignment of as many tasks as possible; a single task is assigned to the nearest agent."""

    name = "group_optimal"
    version = "1"
    bids = FIRST_PASS_BIDS

    def find_group(self, contacts: Sequence[Report], items: Sequence[Item]) -> tuple[Consensus, ...]:
        """Return one decision for each item, sorted by task id."""
        items = sort_items(items)
        slots = {item.task: item.slots for item in items}
        counted = [r for r in standing(contacts) if r.task in slots]
        capacity_left = find_capacities(counted)
        rows = [task for task, places in slots.items() for _ in range(places)]
        bids = select_cheapest(counted, self.bids)
        while True:
            owners = _solve(rows, capacity_left, bids)
            uncovered = {task for task, places in slots.items() if len(owners.get(task, ())) < places}
            more = {(r.task, r.agent): to_millionths(r.cost) for r in counted if r.task in uncovered}
            if more.items() <= bids.items():
                return build_decisions(self.name, counted, items, owners)
            bids |= more


def select_cheapest(contacts: Iterable[Report], most: int) -> dict[tuple[str, str], int]:
    """Return the costs of the ``most`` cheapest tasks of each agent, by task and agent."""
    own: dict[str, list[Report]] = {}
    for report in contacts:
        own.setdefault(report.agent, []).append(report)
    return {
        (r.task, agent): to_millionths(r.cost)
        for agent, reports in own.items()
        for r in sorted(reports, key=lambda r: (r.cost, r.task))[:most]
    }


def _solve(rows: list[str], capacity_left: dict[str, int], bids: dict[tuple[str, str], int]) -> dict[str, list[str]]:
    """Return the agents of each task; no agent has two slots of the same task."""
    columns = [agent for agent, places in capacity_left.items() for _ in range(min(places, len(rows)))]
    of_agent: dict[str, list[int]] = {}
    for column, agent in enumerate(columns):
        of_agent.setdefault(agent, []).append(column)
    of_task: dict[str, list[tuple[str, int]]] = {}
    for (task, agent), cost in bids.items():
        of_task.setdefault(task, []).append((agent, cost))
    unassigned = sum(sorted(bids.values())[-len(rows) :]) + 1
    width = max(len(columns), len(rows))
    banned: set[tuple[int, str]] = set()
    while True:
        costs = []
        for number, task in enumerate(rows):
            line = [unassigned] * width
            for agent, cost in of_task.get(task, ()):
                if (number, agent) not in banned:
                    for column in of_agent.get(agent, ()):
                        line[column] = cost
            costs.append(line)
        owners: dict[str, list[str]] = {}
        has_duplicate = False
        for number, column in enumerate(hungarian.solve(costs)):
            if costs[number][column] < unassigned:
                agent = columns[column]
                if agent in owners.setdefault(rows[number], []):
                    banned.add((number, agent))
                    has_duplicate = True
                else:
                    owners[rows[number]].append(agent)
        if not has_duplicate:
            return {task: sorted(agents) for task, agents in owners.items()}
