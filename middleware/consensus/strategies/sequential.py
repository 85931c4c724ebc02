"""Strategy ``sequential``: tasks are auctioned one after another, each to the agent whose route grows least.

These are sequential single-item auctions under the MiniSum rule (Lagoudakis et al., RSS 2005).  The sum of the route
lengths is at most twice the optimum.  Afterwards, single tasks are moved until this no longer makes the sum shorter.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Mapping, Sequence

from middleware.consensus.assignment import Item, build_decisions, find_capacities, sort_items
from middleware.consensus.strategies.cbba import Cbba
from middleware.consensus.strategy import Consensus, Report, standing

Place = tuple[float, ...]
MAX_SWEEPS = 20
MIN_GAIN_M = 1e-9


class Sequential(Cbba):
    """Routes from each agent's position (``Report.value``) through its tasks.

    A single task is assigned to the nearest agent.
    """

    name = "sequential"
    version = "1"
    reads = ("value",)

    def find_group(self, contacts: Sequence[Report], items: Sequence[Item]) -> tuple[Consensus, ...]:
        """Return one decision per item, sorted by task id; if agents or items have no positions, decide as ``cbba``."""
        items = sort_items(items)
        counted = [r for r in standing(contacts) if r.value]
        routes = plan_routes(contacts, items)
        if routes is None:
            return super().find_group(contacts, items)
        owners = {task: [agent] for agent, route in routes.items() for task in route}
        return build_decisions(self.name, counted, items, owners)


def plan_routes(contacts: Sequence[Report], items: Sequence[Item]) -> dict[str, list[str]] | None:
    """Return each agent's tasks in the order of its route; None if agents or items have no comparable positions.

    An agent that reports for certain tasks gets only these tasks; an agent that reports without a task can get any
    task.
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
    capacity_left = find_capacities(counted)
    biddable = {agent: set(places) if "" in tasks else tasks & places.keys() for agent, tasks in able.items()}
    routes = _run_auction(starts, places, capacity_left, biddable)
    _improve_routes(routes, starts, places, capacity_left, biddable)
    return routes


def compute_length(start: Place, route: Sequence[Place]) -> float:
    """Return the length of the route from ``start`` through all its places."""
    return sum(math.dist(a, b) for a, b in zip((start, *route), route, strict=False))


def find_insertion(start: Place, route: Sequence[Place], place: Place) -> tuple[float, int]:
    """Return the smallest growth of a route when ``place`` is inserted, and the index at which to insert it."""
    best = (math.dist(route[-1] if route else start, place), len(route))
    before = start
    for number, after in enumerate(route):
        growth = math.dist(before, place) + math.dist(place, after) - math.dist(before, after)
        if growth < best[0]:
            best = (growth, number)
        before = after
    return best


def _run_auction(
    starts: Mapping[str, Place],
    places: Mapping[str, Place],
    capacity_left: Mapping[str, int],
    biddable: Mapping[str, set[str]],
) -> dict[str, list[str]]:
    routes: dict[str, list[str]] = {agent: [] for agent in sorted(starts)}
    unsold = set(places)
    bids = [
        (math.dist(starts[agent], places[task]), agent, task, 0)
        for agent in routes
        if capacity_left[agent] > 0
        for task in biddable[agent]
    ]
    heapq.heapify(bids)
    while unsold and bids:
        _, agent, task, sold = heapq.heappop(bids)
        route = routes[agent]
        if task not in unsold or sold != len(route) or sold >= capacity_left[agent]:
            continue  # the agent's route has changed since this bid
        route_places = [places[t] for t in route]
        route.insert(find_insertion(starts[agent], route_places, places[task])[1], task)
        unsold.discard(task)
        if len(route) < capacity_left[agent]:
            route_places = [places[t] for t in route]
            for other in unsold & biddable[agent]:
                heapq.heappush(
                    bids, (find_insertion(starts[agent], route_places, places[other])[0], agent, other, len(route))
                )
    return routes


def _improve_routes(
    routes: dict[str, list[str]],
    starts: Mapping[str, Place],
    places: Mapping[str, Place],
    capacity_left: Mapping[str, int],
    biddable: Mapping[str, set[str]],
) -> None:
    """Move single tasks to shorten the total length, and reverse route segments, until there is no improvement."""
    owners = {task: agent for agent, route in routes.items() for task in route}
    bidders: dict[str, list[str]] = {task: [] for task in sorted(owners)}
    for agent in routes:
        for task in biddable[agent] & bidders.keys():
            bidders[task].append(agent)
    for _ in range(MAX_SWEEPS):
        is_changed = False
        for task in bidders:
            is_changed |= _move_task(task, owners, bidders[task], routes, starts, places, capacity_left)
        for agent, route in routes.items():
            is_changed |= _reverse_segments(route, starts[agent], places)
        if not is_changed:
            return


def _move_task(
    task: str,
    owners: dict[str, str],
    bidders: Sequence[str],
    routes: dict[str, list[str]],
    starts: Mapping[str, Place],
    places: Mapping[str, Place],
    capacity_left: Mapping[str, int],
) -> bool:
    owner = owners[task]
    number = routes[owner].index(task)
    rest = [t for t in routes[owner] if t != task]
    saving = compute_length(starts[owner], [places[t] for t in routes[owner]]) - compute_length(
        starts[owner], [places[t] for t in rest]
    )
    best = (saving - MIN_GAIN_M, owner, number)
    for agent in bidders:
        route = routes[agent]
        if agent != owner and len(route) >= capacity_left[agent]:
            continue
        route_places = [places[t] for t in (rest if agent == owner else route)]
        growth, index = find_insertion(starts[agent], route_places, places[task])
        if growth < best[0]:
            best = (growth, agent, index)
    if best[1:] == (owner, number):
        return False
    routes[owner] = rest
    routes[best[1]].insert(best[2], task)
    owners[task] = best[1]
    return True


def _reverse_segments(route: list[str], start: Place, places: Mapping[str, Place]) -> bool:
    """Reverse segments of a route if that shortens it (2-opt)."""
    is_changed = False
    for first in range(len(route) - 1):
        for last in range(first + 1, len(route)):
            candidate = route[:first] + route[first : last + 1][::-1] + route[last + 1 :]
            if (
                compute_length(start, [places[t] for t in candidate])
                < compute_length(start, [places[t] for t in route]) - MIN_GAIN_M
            ):
                route[:] = candidate
                is_changed = True
    return is_changed
