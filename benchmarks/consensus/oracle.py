"""Reference costs of a mission, by SciPy and OR-Tools if installed, otherwise by algorithms in this module."""

from __future__ import annotations

import math
import random
from typing import Any

from benchmarks.consensus.mission import Mission
from middleware.consensus.strategies import hungarian
from middleware.consensus.strategies.sequential import compute_length, find_insertion

STEPS_PER_S = 60_000
"""Steps of this module's search for short routes, per second of search time of OR-Tools."""


def solve_assignment(mission: Mission) -> tuple[float, str]:
    """Return the exact least sum of distances if each task is a separate trip, and the solver's name."""
    columns = [agent for agent in mission.alive for _ in range(mission.capacity)]
    costs = [[mission.costs[agent][task] for agent in columns] for task in mission.task_positions]
    try:
        import numpy
        from scipy.optimize import linear_sum_assignment
    except ImportError:
        chosen_columns = hungarian.find_optimum(costs)[0]
        return float(sum(row[column] for row, column in zip(costs, chosen_columns, strict=True))), "own Hungarian"
    table: Any = numpy.array(costs, dtype=float)
    rows, chosen = linear_sum_assignment(table)
    return float(table[rows, chosen].sum()), "SciPy"


def search_routes(mission: Mission, ways: dict[str, list[str]], seconds: float) -> tuple[float, str]:
    """Improve the routes ``ways`` through all tasks; return the sum of their lengths, and the solver's name."""
    try:
        return min(measure_routes(mission, ways), _solve_with_ortools(mission, seconds)), "OR-Tools"
    except ImportError:
        return _anneal(mission, ways, round(STEPS_PER_S * seconds)), "own search"


def measure_routes(mission: Mission, ways: dict[str, list[str]]) -> float:
    """Return the sum of the routes through all tasks, in metres."""
    return sum(
        compute_length(mission.agent_positions[a], [mission.task_positions[t] for t in way]) for a, way in ways.items()
    )


def _anneal(mission: Mission, ways: dict[str, list[str]], steps: int) -> float:
    """Improve the routes by simulated annealing: move single tasks, and sometimes accept a longer route."""
    rng = random.Random(mission.seed)
    now = {agent: list(ways.get(agent, ())) for agent in mission.alive}
    agents = list(now)
    best = cost = measure_routes(mission, now)
    heat = cost / max(1, len(mission.task_positions)) * 0.3

    def long(agent: str, way: list[str]) -> float:
        return compute_length(mission.agent_positions[agent], [mission.task_positions[t] for t in way])

    owner = {task: agent for agent, way in now.items() for task in way}
    tasks = sorted(owner)
    for step in range(steps):
        temperature = heat * (1.0 - step / steps) ** 2 + 1e-9
        task = rng.choice(tasks)
        here = owner[task]
        # Choose the same agent, the agent of a random task, or a random agent.
        there = here if rng.random() < 0.3 else owner[rng.choice(tasks)] if rng.random() < 0.7 else rng.choice(agents)
        rest = [t for t in now[here] if t != task]
        target = rest if there == here else now[there]
        if len(target) >= mission.capacity:
            continue
        spared = long(here, now[here]) - long(here, rest)
        more, where = find_insertion(
            mission.agent_positions[there], [mission.task_positions[t] for t in target], mission.task_positions[task]
        )
        if more - spared <= 0.0 or rng.random() < math.exp((spared - more) / temperature):
            now[here] = rest
            now[there] = [*target[:where], task, *target[where:]]
            owner[task] = there
            cost += more - spared
            best = min(best, cost)
    return best


def _solve_with_ortools(mission: Mission, seconds: float) -> float:
    from ortools.constraint_solver import pywrapcp, routing_enums_pb2

    agents, tasks = mission.alive, list(mission.task_positions)
    points = [mission.agent_positions[a] for a in agents] + [mission.task_positions[t] for t in tasks]
    end = len(points)  # a point that is reached at no cost: routes are open at their end
    far = [[round(1000.0 * math.dist(p, q)) for q in points] + [0] for p in points] + [[0] * (end + 1)]
    index = pywrapcp.RoutingIndexManager(end + 1, len(agents), list(range(len(agents))), [end] * len(agents))
    model = pywrapcp.RoutingModel(index)
    # Tables are faster: with callbacks into Python the routes are 1 % longer after the same time.
    model.SetArcCostEvaluatorOfAllVehicles(model.RegisterTransitMatrix(far))
    load = model.RegisterUnaryTransitVector([int(len(agents) <= place < end) for place in range(end + 1)])
    model.AddDimensionWithVehicleCapacity(load, 0, [mission.capacity] * len(agents), True, "load")
    search = pywrapcp.DefaultRoutingSearchParameters()
    search.first_solution_strategy = routing_enums_pb2.FirstSolutionStrategy.PARALLEL_CHEAPEST_INSERTION
    search.local_search_metaheuristic = routing_enums_pb2.LocalSearchMetaheuristic.GUIDED_LOCAL_SEARCH
    search.time_limit.FromMilliseconds(round(1000.0 * seconds))
    found = model.SolveWithParameters(search)
    return found.ObjectiveValue() / 1000.0 if found else math.inf
