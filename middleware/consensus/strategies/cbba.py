"""Consensus-based bundle algorithm: each agent bids for what suits it, and everybody believes the highest bid.

Choi, Brunet, How, IEEE Transactions on Robotics 25(4), 2009.  Where the agents talk by themselves
(``benchmarks.consensus.bidder``) they end at the sequential greedy assignment; here it is found at once from all
reports, and then mended by exchanges.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence

from middleware.consensus.item import Item, Sharing, capacities, exact, listed, shared_out
from middleware.consensus.strategy import Consensus, Report, standing

SWEEPS = 50
"""Passes of exchanges over an assignment at most."""


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


def exchanged(
    owners: Mapping[str, str], costs: Mapping[str, Mapping[str, int]], capacities: Mapping[str, int]
) -> dict[str, str]:
    """Who has each task after tasks have gone to other agents, or two were swapped, as long as that costs less.

    What a greedy assignment loses against the best one is mostly won back so.
    ``costs`` are by agent and task; an agent that names none for a task cannot have it.
    """
    owner = dict(sorted(owners.items()))
    held = Counter(owner.values())
    room = {agent: capacities.get(agent, 1) - held[agent] for agent in costs}
    free = {agent for agent, places in room.items() if places > 0}
    known = {agent: sorted(costs[agent].keys() & owner.keys()) for agent in costs}
    for _ in range(SWEEPS):
        changed = [_moved(task, owner, costs, room, free) | _swapped(task, owner, costs, known) for task in owner]
        if not any(changed):
            break
    return owner


def _moved(
    task: str,
    owner: dict[str, str],
    costs: Mapping[str, Mapping[str, int]],
    room: dict[str, int],
    free: set[str],
) -> bool:
    """Give the task to the agent that has room, as all that are ``free`` have, and to which it costs least."""
    offers = [(costs[agent][task], agent) for agent in free if task in costs[agent]]
    now = owner[task]
    if not offers or min(offers)[0] >= costs[now][task]:
        return False
    then = min(offers)[1]
    owner[task] = then
    for agent, more in ((now, 1), (then, -1)):
        room[agent] += more
        (free.add if room[agent] > 0 else free.discard)(agent)
    return True


def _swapped(
    task: str, owner: dict[str, str], costs: Mapping[str, Mapping[str, int]], known: Mapping[str, list[str]]
) -> bool:
    """Swap the task for the one of another agent, of those that its own has ``known``, by which both gain most."""
    mine = owner[task]
    row = costs[mine]
    least, best = 0, ""
    for other in known[mine]:
        theirs = owner[other]
        if theirs != mine and task in costs[theirs]:
            gain = row[other] + costs[theirs][task] - row[task] - costs[theirs][other]
            if gain < least:
                least, best = gain, other
    if not best:
        return False
    owner[task], owner[best] = owner[best], mine
    return True
