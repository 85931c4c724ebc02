"""Consensus-based bundle algorithm: each agent bids for what suits it, and everybody believes the highest bid.

Choi, Brunet, How, IEEE Transactions on Robotics 25(4), 2009.  Where the agents talk by themselves (``bidder``) they end
at the sequential greedy assignment; here it is found at once from all reports, and then mended by exchanges.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from middleware.consensus.item import Item, Sharing, capacities, exact, listed, shared_out
from middleware.consensus.strategies.exchange import exchanged
from middleware.consensus.strategy import Consensus, Report, standing


class Cbba(Sharing):
    """The greedy assignment, task by task the cheapest pair, improved by exchanges; with one task the nearest."""

    name = "cbba"
    version = "1"

    def find_group(self, contacts: Sequence[Report], items: Sequence[Item]) -> tuple[Consensus, ...]:
        """One consensus point for each item, one agent each, in the order of their names."""
        items = listed(items)
        wanted = {item.task for item in items}
        counted = [r for r in standing(contacts) if r.task in wanted]
        room = capacities(counted)
        costs: dict[str, dict[str, int]] = {agent: {} for agent in room}
        for report in counted:
            costs[report.agent][report.task] = exact(report.cost)
        owners = exchanged(greedy(costs, room), costs, room)
        return shared_out(self.name, counted, items, {task: [agent] for task, agent in owners.items()})


def greedy(costs: Mapping[str, Mapping[str, float]], capacities: Mapping[str, int]) -> dict[str, str]:
    """Who has each task, when always the cheapest pair of agent and task is made next; equal ones go by id."""
    room = dict(capacities)
    owner: dict[str, str] = {}
    pairs: Iterable[tuple[float, str, str]] = sorted((c, a, t) for a, row in costs.items() for t, c in row.items())
    for _, agent, task in pairs:
        if task not in owner and room.get(agent, 1) > 0:
            owner[task] = agent
            room[agent] = room.get(agent, 1) - 1
    return owner
