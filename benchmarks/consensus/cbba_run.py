"""Run CBBA between the agents in rounds, over a graph in which each agent has four neighbours."""

from __future__ import annotations

import random
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import msgpack

from benchmarks.consensus.bidder import Bidder, Score, Statement
from benchmarks.consensus.mission import SIDE_M, Mission
from middleware.consensus.strategies.cbba import improve_assignment

PAUSE_ROUNDS = 5
"""Rounds between two messages of an agent; a message contains all changes since the previous one."""
MAX_SCORE = 3.0 * SIDE_M
ROUND_S = 0.030
"""Seconds of a round, one mean network delay: 20 ms plus 10 ms on average."""


@dataclass(frozen=True)
class CbbaRun:
    """The owners of each task (possibly two), rounds, messages and bytes per agent, and processor time."""

    owners: dict[str, list[str]]
    rounds: int
    messages: float
    message_bytes: float
    cpu_s: float


def find_partners(agent: str, owners: Mapping[str, str], near: Iterable[str], most: int = 16) -> list[str]:
    """Return candidates for an exchange: the owners of the tasks that the agent prefers, in the order of ``near``."""
    found: dict[str, None] = {}
    for task in near:
        owner = owners.get(task, agent)
        if owner != agent:
            found[owner] = None
            if len(found) >= most:
                break
    return list(found)


def exchange_tasks(
    one: str,
    other: str,
    owners: Mapping[str, str],
    costs: Mapping[str, Mapping[str, int]],
    capacities: Mapping[str, int],
) -> dict[str, str]:
    """Return the owners of the tasks of two agents after an exchange in which both know the costs of both."""
    both = {task: agent for task, agent in owners.items() if agent in (one, other)}
    rows = {agent: {task: costs[agent][task] for task in both if task in costs[agent]} for agent in (one, other)}
    return improve_assignment(both, rows, capacities)


def run_meetings(mission: Mission, owners: dict[str, str]) -> tuple[dict[str, str], float]:
    """Exchange pairwise until no exchange improves the cost; return the owners, and the messages of each agent.

    An exchange is one message in each direction; a pair whose exchange had no effect repeats it only after a change.
    """
    room = dict.fromkeys(mission.alive, mission.capacity)
    near = {agent: [task for _, task in ways] for agent, ways in mission.nearest_tasks.items()}
    owners = dict(owners)
    held: dict[str, dict[str, str]] = {agent: {} for agent in mission.alive}
    for task, agent in owners.items():
        held[agent][task] = agent
    messages = 0
    seen: set[frozenset[tuple[str, str]]] = set()
    is_changed = True
    while is_changed:
        is_changed = False
        for agent in mission.alive:
            for other in find_partners(agent, owners, near[agent]):
                both = held[agent] | held[other]
                state = frozenset(both.items())
                if state in seen:
                    continue
                seen.add(state)
                messages += 2
                now = exchange_tasks(agent, other, both, mission.costs, room)
                if now != both:
                    owners.update(now)
                    for one in (agent, other):
                        held[one] = {task: owner for task, owner in now.items() if owner == one}
                    is_changed = True
    return owners, messages / len(mission.alive)


def make_graph(names: list[str], seed: int) -> dict[str, list[str]]:
    """Return the neighbours of each agent: two random rings through all agents, so the graph is connected."""
    rng = random.Random(f"graph/{seed}")
    found: dict[str, set[str]] = {name: set() for name in names}
    for _ in range(2):
        ring = rng.sample(names, len(names))
        for one, other in zip(ring, ring[1:] + ring[:1], strict=True):
            if one != other:
                found[one].add(other)
                found[other].add(one)
    return {name: sorted(others) for name, others in found.items()}


def make_score(costs: dict[str, int]) -> Score:
    """Return a score that decreases with the distance and does not depend on the bundle."""
    worth = {task: MAX_SCORE - cost * 1e-6 for task, cost in costs.items()}
    return lambda bundle, task: worth[task]


def run_cbba(mission: Mission, pause: int = PAUSE_ROUNDS, loss: float = 0.0, quiet: int | None = None) -> CbbaRun:
    """Run the bidders of a mission until no messages are left, or no message was sent for ``quiet`` rounds.

    A lost message is not acknowledged and is therefore sent again in the next round.
    """
    graph = make_graph(mission.alive, mission.seed)
    rng = random.Random(f"loss/{mission.seed}")
    started_at = time.process_time()
    bidders = {
        name: Bidder(name, mission.task_positions, make_score(mission.costs[name]), mission.capacity, graph[name])
        for name in mission.alive
    }
    measured = 0.0
    messages = octets = rounds = silent = 0
    last = 0
    on_the_way: list[tuple[str, str, tuple[Statement, ...]]] = []
    while quiet is None or silent < quiet:
        rounds += 1
        arriving, on_the_way = on_the_way, []
        for sender, taker, statements in arriving:
            if loss and rng.random() < loss:
                on_the_way.append((sender, taker, statements))
            elif corrections := bidders[taker].receive(sender, statements):
                on_the_way.append((taker, sender, tuple(corrections)))
        for number, (name, bidder) in enumerate(bidders.items()):
            if (rounds + number) % pause == 0:
                on_the_way += [(name, other, news) for other, news in bidder.drain().items()]
        silent = 0 if on_the_way else silent + 1
        last = rounds if on_the_way else last
        counted = time.process_time()
        messages += len(on_the_way)
        octets += sum(len(encode_message(statements)) for _, _, statements in on_the_way)
        measured += time.process_time() - counted
        if quiet is None and not on_the_way and all(bidder.is_quiet for bidder in bidders.values()):
            break
    owners: dict[str, list[str]] = {}
    for name, bidder in bidders.items():
        for task in bidder.bundle:
            owners.setdefault(task, []).append(name)
    each = len(bidders)
    return CbbaRun(owners, last, messages / each, octets / each, time.process_time() - started_at - measured)


def encode_message(statement: tuple[Statement, ...]) -> bytes:
    """Encode a message: tasks and agents by their number in the epoch."""
    return bytes(msgpack.packb([(int(s.task[1:]), int(s.agent[1:]), s.version, s.bid) for s in statement]))
