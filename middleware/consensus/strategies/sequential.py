"""Sequential auction: tasks are sold one after the other to the agent whose way grows least by them.

Sequential single-item auctions under the MiniSum rule (Lagoudakis and others, RSS 2005): at most twice the best sum of
ways.  Afterwards single tasks change their place as long as that shortens the sum.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Mapping, Sequence

from middleware.consensus.item import Item, capacities, listed, shared_out
from middleware.consensus.strategies.cbba import Cbba
from middleware.consensus.strategy import Consensus, Report, standing

Place = tuple[float, ...]
SWEEPS = 20
NO_GAIN = 1e-9


class Sequential(Cbba):
    """Ways from where each agent stands (``Report.value``) through the positions of its items; one task: nearest."""

    name = "sequential"
    version = "1"
    reads = ("value",)

    def find_group(self, contacts: Sequence[Report], items: Sequence[Item]) -> tuple[Consensus, ...]:
        """One consensus point for each item, in the order of their names; without positions as ``cbba`` does it."""
        items = listed(items)
        counted = [r for r in standing(contacts) if r.value]
        ways = ways_of(contacts, items)
        if ways is None:
            return super().find_group(contacts, items)
        owners = {task: [agent] for agent, way in ways.items() for task in way}
        return shared_out(self.name, counted, items, owners)


def ways_of(contacts: Sequence[Report], items: Sequence[Item]) -> dict[str, list[str]] | None:
    """The tasks of each agent in the order of its way; None where agents or items have no comparable positions.

    An agent that reports about tasks by name takes only those; one that names none takes any.
    """
    counted = [r for r in standing(contacts) if r.value]
    places = {item.task: item.position for item in items}
    starts: dict[str, Place] = {}
    able: dict[str, set[str]] = {}
    for report in counted:
        starts.setdefault(report.agent, report.value)
        able.setdefault(report.agent, set()).add(report.task)
    sizes = {len(place) for place in (*starts.values(), *places.values())}
    if len(sizes) != 1 or 0 in sizes:
        return None
    room = capacities(counted)
    wanted = {agent: set(places) if "" in tasks else tasks & places.keys() for agent, tasks in able.items()}
    ways = _auctioned(starts, places, room, wanted)
    _mended(ways, starts, places, room, wanted)
    return ways


def length(start: Place, way: Sequence[Place]) -> float:
    """How long a way is from ``start`` through all its places."""
    return sum(math.dist(a, b) for a, b in zip((start, *way), way, strict=False))


def insertion(start: Place, way: Sequence[Place], place: Place) -> tuple[float, int]:
    """By how much a way grows at least, if it goes through one more place, and where that place comes in it."""
    best = (math.dist(way[-1] if way else start, place), len(way))
    before = start
    for number, after in enumerate(way):
        more = math.dist(before, place) + math.dist(place, after) - math.dist(before, after)
        if more < best[0]:
            best = (more, number)
        before = after
    return best


def _auctioned(
    starts: Mapping[str, Place], places: Mapping[str, Place], room: Mapping[str, int], wanted: Mapping[str, set[str]]
) -> dict[str, list[str]]:
    ways: dict[str, list[str]] = {agent: [] for agent in sorted(starts)}
    left = set(places)
    bids = [
        (math.dist(starts[agent], places[task]), agent, task, 0)
        for agent in ways
        if room[agent] > 0
        for task in wanted[agent]
    ]
    heapq.heapify(bids)
    while left and bids:
        _, agent, task, sold = heapq.heappop(bids)
        way = ways[agent]
        if task not in left or sold != len(way) or sold >= room[agent]:
            continue  # made before the agent's way changed
        here = [places[t] for t in way]
        way.insert(insertion(starts[agent], here, places[task])[1], task)
        left.discard(task)
        if len(way) < room[agent]:
            here = [places[t] for t in way]
            for other in left & wanted[agent]:
                heapq.heappush(bids, (insertion(starts[agent], here, places[other])[0], agent, other, len(way)))
    return ways


def _mended(
    ways: dict[str, list[str]],
    starts: Mapping[str, Place],
    places: Mapping[str, Place],
    room: Mapping[str, int],
    wanted: Mapping[str, set[str]],
) -> None:
    """Take single tasks out and put them where they cost less, in the own way or another, and turn parts of ways."""
    owners = {task: agent for agent, way in ways.items() for task in way}
    bidders: dict[str, list[str]] = {task: [] for task in sorted(owners)}
    for agent in ways:
        for task in wanted[agent] & bidders.keys():
            bidders[task].append(agent)
    for _ in range(SWEEPS):
        is_changed = False
        for task in bidders:
            is_changed |= _moved(task, owners, bidders[task], ways, starts, places, room)
        for agent, way in ways.items():
            is_changed |= _turned(way, starts[agent], places)
        if not is_changed:
            return


def _moved(
    task: str,
    owners: dict[str, str],
    bidders: Sequence[str],
    ways: dict[str, list[str]],
    starts: Mapping[str, Place],
    places: Mapping[str, Place],
    room: Mapping[str, int],
) -> bool:
    owner = owners[task]
    number = ways[owner].index(task)
    rest = [t for t in ways[owner] if t != task]
    spared = length(starts[owner], [places[t] for t in ways[owner]]) - length(starts[owner], [places[t] for t in rest])
    best = (spared - NO_GAIN, owner, number)
    for agent in bidders:
        way = ways[agent]
        if agent != owner and len(way) >= room[agent]:
            continue
        here = [places[t] for t in (rest if agent == owner else way)]
        more, where = insertion(starts[agent], here, places[task])
        if more < best[0]:
            best = (more, agent, where)
    if best[1:] == (owner, number):
        return False
    ways[owner] = rest
    ways[best[1]].insert(best[2], task)
    owners[task] = best[1]
    return True


def _turned(way: list[str], start: Place, places: Mapping[str, Place]) -> bool:
    """Walk a part of a way backwards where that is shorter (2-opt)."""
    is_changed = False
    for first in range(len(way) - 1):
        for last in range(first + 1, len(way)):
            turned = way[:first] + way[first : last + 1][::-1] + way[last + 1 :]
            if length(start, [places[t] for t in turned]) < length(start, [places[t] for t in way]) - NO_GAIN:
                way[:] = turned
                is_changed = True
    return is_changed
