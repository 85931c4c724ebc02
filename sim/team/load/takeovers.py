"""Workload: lease holders die at random times; measures the time until another agent holds the lease.

Each trial is a separate task with three agents: one holds the lease and two are standbys, as in a team.  Several trials
may run at once.  A trial does not count if a majority of the task's council is dead as well, as no agent may take over
then (invariant E3).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

from msgspec import Meta
from twisted.internet.defer import Deferred

from formats.convert import Unit
from middleware.consensus.lease.lessee import Lessee
from middleware.entangled.errors import EntangledError
from middleware.tasks.task import Task
from sim.team.figure import Figure, at_most, share, spread
from sim.team.load.deputies import Deputy, deputies_of
from sim.team.load.residents import Load, Pace
from sim.team.team import Team

AGENTS = 3
PATIENCE = 30.0
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


class Trial:
    """One task, its three agents, and the time of the holder's death."""

    def __init__(self, task: Task, agents: list[Deputy]) -> None:
        self.task = task
        self.agents = agents
        self.lessees: list[Lessee] = []
        self.died_at = math.inf
        self.gone: Deputy | None = None
        self.has_quorum = True


class Takeovers(Load):
    """The workload ``takeovers``."""

    def __init__(self, team: Team, settings: TakeoverSettings) -> None:
        super().__init__(team, "takeovers")
        self._settings = settings
        self._deputies = deputies_of(team)
        self._pace = Pace(team.clock, settings.rate, settings.count)
        self._begun = self._due = 0
        self._busy: set[int] = set()
        self.seconds: list[float] = []
        self.never = self.overlaps = self.unheld = 0

    def step(self) -> None:
        """Start the trials that are due, while there are agents without a trial."""
        self._due += self._pace.due()
        while self._due and self._begin():
            self._due -= 1

    def verdict(self) -> list[str]:
        """Return leases held by two agents at once (E2), and tasks without a takeover (E3)."""
        found = [f"E2: {self.overlaps} times two agents held one lease"] if self.overlaps else []
        return found + ([f"E3: {self.never} tasks were not taken over"] if self.never else [])

    def figures(self) -> list[Figure]:
        """Return the takeover times and the numbers of failures."""
        n = len(self.seconds) + self.never
        return [
            *spread("takeovers.seconds", self.seconds, "s", (0.5, 0.95, 0.99)),
            at_most("takeovers.never", float(self.never), "tasks", 0.0, n=n),
            at_most("takeovers.overlaps", float(self.overlaps), "leases", 0.0, n=n),
            share("takeovers.begun", n, n + self.unheld + self._due),
        ]

    # -- inside -----------------------------------------------------------------------------------------------------

    def _begin(self) -> bool:
        free = [place for place in self._residents.any(self._rng, 4 * AGENTS) if place not in self._busy]
        agents = [deputy for place in free[:AGENTS] if (deputy := self._deputies.of(place)) is not None]
        if len(agents) < AGENTS:
            return False
        self._begun += 1
        task = Task(f"takeover {self._begun}", "none", "nothing", lease_ttl=self._settings.ttl)
        trial = Trial(task, agents)
        self._busy.update(agent.place for agent in agents)
        Deferred.fromCoroutine(self._prepare(trial))
        return True

    async def _prepare(self, trial: Trial) -> None:
        """Let the first agent hold the lease and the others be standbys, then schedule the holder's death."""
        try:
            trial.task = await trial.agents[0].pinned(trial.task)
        except EntangledError:
            self._end(trial)
            self.unheld += 1
            return
        for agent in trial.agents:
            trial.lessees.append(agent.lessee(trial.task, lambda: self._on_lease_change(trial)))
        for rank, lessee in enumerate(trial.lessees):
            if rank:
                lessee.stand_by(rank)
            else:
                lessee.want()
        ttl = self._settings.ttl
        self._clock.callLater(2.0 * ttl + self._rng.uniform(0.0, ttl), self._kill, trial)

    def _kill(self, trial: Trial) -> None:
        holder = next((place for place, lessee in enumerate(trial.lessees) if lessee.lease is not None), None)
        if holder is None or not all(self._deputies.lives(agent) for agent in trial.agents):
            self.unheld += 1  # a fault of the scenario came first
            self._end(trial)
            return
        trial.gone, trial.died_at = trial.agents[holder], self._clock.seconds()
        self._team.kill(trial.gone.place)
        there = sum(member.node_id in self._residents.census for member in trial.task.council)
        trial.has_quorum = 2 * there > len(trial.task.council)
        self._clock.callLater(self._settings.away, self._return, trial.gone.place)
        self._clock.callLater(PATIENCE, self._give_up, trial)

    def _on_lease_change(self, trial: Trial) -> None:
        held = [
            lessee
            for agent, lessee in zip(trial.agents, trial.lessees, strict=False)
            if lessee.lease is not None and self._deputies.lives(agent)
        ]
        self.overlaps += max(0, len(held) - 1)
        if held and trial.died_at != math.inf:
            if trial.has_quorum:
                self.seconds.append(self._clock.seconds() - trial.died_at)
            else:
                self.unheld += 1
            trial.died_at = math.inf
            self._clock.callLater(self._settings.ttl, self._end, trial)

    def _give_up(self, trial: Trial) -> None:
        if trial.died_at == math.inf:
            return
        trial.died_at = math.inf
        if trial.has_quorum and sum(self._deputies.lives(agent) for agent in trial.agents) == AGENTS - 1:
            self.never += 1
        else:
            self.unheld += 1
        self._end(trial)

    def _return(self, place: int) -> None:
        if place not in self._team.living:
            self._team.start(place)

    def _end(self, trial: Trial) -> None:
        for agent, lessee in zip(trial.agents, trial.lessees, strict=False):
            if self._deputies.lives(agent):
                lessee.release()
        self._busy.difference_update(agent.place for agent in trial.agents)
