"""Exchange: neighbours of an assignment that cost less: a task goes to another agent, or two agents swap tasks.

What a greedy assignment loses against the best one is mostly won back by it.  Used on a whole assignment, or by two
agents on what the two of them hold; either way it never costs more than before.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping

SWEEPS = 50


def exchanged(
    owners: Mapping[str, str], costs: Mapping[str, Mapping[str, int]], capacities: Mapping[str, int]
) -> dict[str, str]:
    """Who has each task afterwards; ``costs`` are by agent and task, and who names none cannot have the task."""
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


def partners(agent: str, owners: Mapping[str, str], near: Iterable[str], most: int = 16) -> list[str]:
    """Whom an agent should meet, to swap with: who has the tasks that it would have liked best, ``near`` in order."""
    found: dict[str, None] = {}
    for task in near:
        owner = owners.get(task, agent)
        if owner != agent:
            found[owner] = None
            if len(found) >= most:
                break
    return list(found)


def met(
    one: str,
    other: str,
    owners: Mapping[str, str],
    costs: Mapping[str, Mapping[str, int]],
    capacities: Mapping[str, int],
) -> dict[str, str]:
    """Who of two agents has each of their tasks after they met: each told the other what those tasks cost it."""
    both = {task: agent for task, agent in owners.items() if agent in (one, other)}
    rows = {agent: {task: costs[agent][task] for task in both if task in costs[agent]} for agent in (one, other)}
    return exchanged(both, rows, capacities)


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
