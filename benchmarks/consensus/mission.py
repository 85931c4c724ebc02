"""A mission: agents and tasks in a square of one kilometre, and failures of agents; equal seeds give equal missions."""

from __future__ import annotations

import math
import random
from collections.abc import Collection
from dataclasses import dataclass
from functools import cached_property

from middleware.consensus.assignment import Item, to_millionths
from middleware.consensus.strategy import Report

SIDE_M = 1000.0
Position = tuple[float, float]


@dataclass(frozen=True)
class Mission:
    """``agents`` and ``tasks`` from a seed; ``failed`` percent of the agents fail after they have bid."""

    agents: int
    tasks: int
    seed: int
    failed: int = 0
    spare: int = 0

    @cached_property
    def capacity(self) -> int:
        """Maximum tasks per agent: the minimum with which the remaining agents can do all tasks, plus ``spare``."""
        return math.ceil(self.tasks / max(1, len(self.alive))) + self.spare

    @cached_property
    def agent_positions(self) -> dict[str, Position]:
        """The position of each agent."""
        rng = random.Random(f"agents/{self.agents}/{self.tasks}/{self.seed}")
        return {f"a{n:04d}": (rng.uniform(0, SIDE_M), rng.uniform(0, SIDE_M)) for n in range(self.agents)}

    @cached_property
    def task_positions(self) -> dict[str, Position]:
        """The position of each task."""
        rng = random.Random(f"tasks/{self.agents}/{self.tasks}/{self.seed}")
        return {f"t{n:04d}": (rng.uniform(0, SIDE_M), rng.uniform(0, SIDE_M)) for n in range(self.tasks)}

    @cached_property
    def alive(self) -> list[str]:
        """The agents that do not fail."""
        rng = random.Random(f"failed/{self.agents}/{self.seed}")
        gone = set(rng.sample(range(self.agents), self.agents * self.failed // 100))
        return [agent for number, agent in enumerate(sorted(self.agent_positions)) if number not in gone]

    @cached_property
    def items(self) -> list[Item]:
        """The tasks as input of the strategies."""
        return [Item(task, place) for task, place in self.task_positions.items()]

    @cached_property
    def costs(self) -> dict[str, dict[str, int]]:
        """The distance from each agent to each task, in whole micrometres."""
        return {
            a: {t: to_millionths(math.dist(s, p)) for t, p in self.task_positions.items()}
            for a, s in self.agent_positions.items()
        }

    @cached_property
    def nearest_tasks(self) -> dict[str, list[tuple[float, str]]]:
        """For each agent, pairs of the distance to a task in metres and the task, the nearest first."""
        return {
            a: sorted((math.dist(s, p), t) for t, p in self.task_positions.items())
            for a, s in self.agent_positions.items()
        }

    def make_reports(self, agents: list[str], bids: int, also: Collection[str] = ()) -> list[Report]:
        """Return the bids of some agents, each for its ``bids`` nearest tasks and for the tasks ``also``."""
        found = []
        for agent in agents:
            start, ways = self.agent_positions[agent], self.nearest_tasks[agent]
            ways = ways[:bids] + [(way, task) for way, task in ways[bids:] if task in also]
            found += [Report(agent, way, task=t, value=start, capacity=self.capacity) for way, t in ways]
        return found
