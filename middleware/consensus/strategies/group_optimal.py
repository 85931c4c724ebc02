"""Group optimum: several tasks are shared out so that all together they cost least.

The reports are gathered where one agent solves for all (a council member), each agent naming its cheapest tasks; what
nobody named is looked at a second time with all reports that there are.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from middleware.consensus.item import Item, Sharing, capacities, exact, listed, shared_out
from middleware.consensus.strategies import hungarian
from middleware.consensus.strategy import Consensus, Report, standing

BIDS = 20
"""Bids that count of each agent at first; that many fit into one datagram, and cost about 1 % of the optimum."""


class GroupOptimal(Sharing):
    """The cheapest way to serve as many tasks as can be served; with one task it is the nearest."""

    name = "group_optimal"
    version = "1"
    bids = BIDS

    def find_group(self, contacts: Sequence[Report], items: Sequence[Item]) -> tuple[Consensus, ...]:
        """One consensus point for each item, in the order of their names."""
        items = listed(items)
        slots = {item.task: item.slots for item in items}
        counted = [r for r in standing(contacts) if r.task in slots]
        room = capacities(counted)
        rows = [task for task, places in slots.items() for _ in range(places)]
        bids = cheapest(counted, self.bids)
        while True:
            owners = _solved(rows, room, bids)
            holes = {task for task, places in slots.items() if len(owners.get(task, ())) < places}
            more = {(r.task, r.agent): exact(r.cost) for r in counted if r.task in holes}
            if more.items() <= bids.items():
                return shared_out(self.name, counted, items, owners)
            bids |= more


def cheapest(contacts: Iterable[Report], most: int) -> dict[tuple[str, str], int]:
    """What the tasks cost that each agent would rather have, ``most`` of each, by task and agent."""
    own: dict[str, list[Report]] = {}
    for report in contacts:
        own.setdefault(report.agent, []).append(report)
    return {
        (r.task, agent): exact(r.cost)
        for agent, reports in own.items()
        for r in sorted(reports, key=lambda r: (r.cost, r.task))[:most]
    }


def _solved(rows: list[str], room: dict[str, int], bids: dict[tuple[str, str], int]) -> dict[str, list[str]]:
    """The agents of each task; an agent is never twice at one task."""
    columns = [agent for agent, places in room.items() for _ in range(min(places, len(rows)))]
    of_agent: dict[str, list[int]] = {}
    for column, agent in enumerate(columns):
        of_agent.setdefault(agent, []).append(column)
    of_task: dict[str, list[tuple[str, int]]] = {}
    for (task, agent), cost in bids.items():
        of_task.setdefault(task, []).append((agent, cost))
    nobody = sum(sorted(bids.values())[-len(rows) :]) + 1
    width = max(len(columns), len(rows))
    banned: set[tuple[int, str]] = set()
    while True:
        costs = []
        for number, task in enumerate(rows):
            line = [nobody] * width
            for agent, cost in of_task.get(task, ()):
                if (number, agent) not in banned:
                    for column in of_agent.get(agent, ()):
                        line[column] = cost
            costs.append(line)
        owners: dict[str, list[str]] = {}
        twice = False
        for number, column in enumerate(hungarian.assigned(costs)):
            if costs[number][column] < nobody:
                agent = columns[column]
                if agent in owners.setdefault(rows[number], []):
                    banned.add((number, agent))
                    twice = True
                else:
                    owners[rows[number]].append(agent)
        if not twice:
            return {task: sorted(agents) for task, agents in owners.items()}
