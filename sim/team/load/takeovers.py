"""Workload: lease holders die at random times; measures the time until another agent holds the lease.

Each trial is a separate task with three agents: one holds the lease and two are standbys, as in a team.  Several
trials may run at the same time. A trial is not counted if a majority of the task's council is also dead, because no
agent may take over then (invariant E3).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

from msgspec import Meta
from twisted.internet.defer import Deferred

from formats.convert import Unit
from middleware.consensus.lease.lease_client import LeaseClient
from middleware.entangled.errors import EntangledError
from middleware.tasks.task import Task
from sim.team.load.bidding_agents import BiddingAgent, get_bidding_agents
from sim.team.load.client_workload import ClientWorkload, Pacer
from sim.team.metric import Metric, make_maximum, make_percentiles, make_share
from sim.team.team import Team

AGENTS_PER_TASK = 3
TAKEOVER_LIMIT_S = 30.0
"""Seconds after which a takeover counts as failed."""


@dataclass(frozen=True)
class TakeoverSettings:
    """``[load.takeovers]``: the number and rate of holders that die."""

    count: Annotated[int, Meta(ge=1, le=1_000_000)] = 200
    """Total number of trials."""

    rate: Annotated[float, Meta(ge=0.0001, le=1000.0)] = 0.1
    """Trials started per second."""

    ttl: Annotated[float, Meta(ge=0.1, le=60.0), Unit("seconds")] = 1.5
    """Time to live of a lease in seconds."""

    away: Annotated[float, Meta(ge=0.1, le=3600.0), Unit("seconds")] = 10.0
    """Seconds after which a dead node restarts from its disk."""


class TakeoverTrial:
    """One task, its three agents, and the time of the holder's death."""

    def __init__(self, task: Task, agents: list[BiddingAgent]) -> None:
        self.task = task
        self.agents = agents
        self.lease_clients: list[LeaseClient] = []
        self.died_at = math.inf
        self.dead_agent: BiddingAgent | None = None
        self.has_quorum = True


class Takeovers(ClientWorkload):
    """The workload ``takeovers``."""

    def __init__(self, team: Team, settings: TakeoverSettings) -> None:
        super().__init__(team, "takeovers")
        self._settings = settings
        self._agents = get_bidding_agents(team)
        self._pace = Pacer(team.clock, settings.rate, settings.count)
        self._begun = self._due = 0
        self._busy: set[int] = set()
        self.seconds: list[float] = []
        self.missed_count = self.overlaps = self.void_count = 0

    def step(self) -> None:
        """Start the trials that are due, as long as agents without a trial are available."""
        self._due += self._pace.take_due()
        while self._due and self._start_trial():
            self._due -= 1

    def find_violations(self) -> list[str]:
        """Return the leases held by two agents at the same time (E2), and the tasks without a takeover (E3)."""
        found = [f"E2: {self.overlaps} times two agents held one lease"] if self.overlaps else []
        return found + ([f"E3: {self.missed_count} tasks were not taken over"] if self.missed_count else [])

    def collect_metrics(self) -> list[Metric]:
        """Return the takeover times and the numbers of failures."""
        n = len(self.seconds) + self.missed_count
        return [
            *make_percentiles("takeovers.seconds", self.seconds, "s", (0.5, 0.95, 0.99)),
            make_maximum("takeovers.never", float(self.missed_count), "tasks", 0.0, n=n),
            make_maximum("takeovers.overlaps", float(self.overlaps), "leases", 0.0, n=n),
            make_share("takeovers.begun", n, n + self.void_count + self._due),
        ]

    # -- inside -----------------------------------------------------------------------------------------------------

    def _start_trial(self) -> bool:
        free = [place for place in self._joined.any(self._rng, 4 * AGENTS_PER_TASK) if place not in self._busy]
        agents = [agent for place in free[:AGENTS_PER_TASK] if (agent := self._agents.get(place)) is not None]
        if len(agents) < AGENTS_PER_TASK:
            return False
        self._begun += 1
        task = Task(f"takeover {self._begun}", "none", "nothing", lease_ttl=self._settings.ttl)
        trial = TakeoverTrial(task, agents)
        self._busy.update(agent.place for agent in agents)
        Deferred.fromCoroutine(self._prepare(trial))
        return True

    async def _prepare(self, trial: TakeoverTrial) -> None:
        """Let the first agent claim the lease and the other agents be standbys, then schedule the holder's death."""
        try:
            trial.task = await trial.agents[0].pin_council(trial.task)
        except EntangledError:
            self._end(trial)
            self.void_count += 1
            return
        for agent in trial.agents:
            trial.lease_clients.append(agent.make_lease_client(trial.task, lambda: self._on_lease_change(trial)))
        for rank, lease_client in enumerate(trial.lease_clients):
            if rank:
                lease_client.stand_by(rank)
            else:
                lease_client.claim()
        ttl = self._settings.ttl
        self._clock.callLater(2.0 * ttl + self._rng.uniform(0.0, ttl), self._kill, trial)

    def _kill(self, trial: TakeoverTrial) -> None:
        holder = next(
            (place for place, lease_client in enumerate(trial.lease_clients) if lease_client.lease is not None), None
        )
        if holder is None or not all(self._agents.is_alive(agent) for agent in trial.agents):
            self.void_count += 1  # a fault of the scenario affected the trial earlier
            self._end(trial)
            return
        trial.dead_agent, trial.died_at = trial.agents[holder], self._clock.seconds()
        self._team.kill(trial.dead_agent.place)
        there = sum(member.node_id in self._joined.id_index for member in trial.task.council)
        trial.has_quorum = 2 * there > len(trial.task.council)
        self._clock.callLater(self._settings.away, self._restart, trial.dead_agent.place)
        self._clock.callLater(TAKEOVER_LIMIT_S, self._give_up, trial)

    def _on_lease_change(self, trial: TakeoverTrial) -> None:
        held = [
            lease_client
            for agent, lease_client in zip(trial.agents, trial.lease_clients, strict=False)
            if lease_client.lease is not None and self._agents.is_alive(agent)
        ]
        self.overlaps += max(0, len(held) - 1)
        if held and trial.died_at != math.inf:
            if trial.has_quorum:
                self.seconds.append(self._clock.seconds() - trial.died_at)
            else:
                self.void_count += 1
            trial.died_at = math.inf
            self._clock.callLater(self._settings.ttl, self._end, trial)

    def _give_up(self, trial: TakeoverTrial) -> None:
        if trial.died_at == math.inf:
            return
        trial.died_at = math.inf
        if trial.has_quorum and sum(self._agents.is_alive(agent) for agent in trial.agents) == AGENTS_PER_TASK - 1:
            self.missed_count += 1
        else:
            self.void_count += 1
        self._end(trial)

    def _restart(self, place: int) -> None:
        if place not in self._team.living:
            self._team.start(place)

    def _end(self, trial: TakeoverTrial) -> None:
        for agent, lease_client in zip(trial.agents, trial.lease_clients, strict=False):
            if self._agents.is_alive(agent):
                lease_client.release()
        self._busy.difference_update(agent.place for agent in trial.agents)
