"""The experiment of the thesis with hundreds of agents, which search a red target until one of them approaches it.

The caller provides the team; this module measures the positions of the robots and the reports of the agents.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from sim.robots.crowd.simulator import CrowdSimulator

POLL_S = 0.5
"""Interval between two measurements in virtual seconds."""
SLICES = 10
PLACE_TARGET_S = 5.0
"""Seconds after the task's assignment at which the target is placed, during the search."""
SLACK_M = 0.1
"""Fraction by which another agent may be nearer than the selected agent: reports contain measurement errors."""


@dataclass(frozen=True)
class AgentStatus:
    """The state of one agent: its distance to the target (None if unknown), and the agent that it assigned."""

    cost: float | None
    assigned: str


class SearchTeam(Protocol):
    """The agents whose robots are in a crowd, on one clock in virtual time."""

    clock: Any
    switchboard: Any
    simulator: CrowdSimulator

    def assign(self) -> None:
        """Publish the task for all agents that can do it."""

    def get_statuses(self) -> Mapping[str, AgentStatus]:
        """Return the state of each participating agent, by its name."""

    def find_finisher(self) -> str | None:
        """Return the agent that completed the task, None while it is open."""

    def stop(self) -> None:
        """Stop all nodes."""


@dataclass
class Outcome:
    """Results and cost of a search; times in virtual seconds since the task was assigned, cost in CPU seconds.

    ``found`` is the number of agents that had found the target at the time of the agreement, or at the end; ``right``
    is whether none of these was much nearer than the selected agent.  ``cost`` has the parts ``moving`` (robots, rays
    and controllers), ``telling`` (sensor frames and pictures) and ``agents`` (nodes, drivers and agents).  ``trail`` is
    the path of the selected robot.
    """

    seed: int
    agents: int
    bodies: int
    seconds: float = 0.0
    engaged: float | None = None
    first: float | None = None
    found: int = 0
    agree: float | None = None
    by: str = ""
    right: bool | None = None
    reach: float | None = None
    datagrams: int = 0
    cost: dict[str, float] = field(default_factory=dict)
    digest: str = ""
    trail: list[tuple[float, float]] = field(default_factory=list)


def run_search(
    team: SearchTeam,
    seed: int,
    limit: float,
    stopwatch: Callable[[], float],
    show: Callable[[Outcome], None] = lambda outcome: None,
    is_over: Callable[[], bool] = lambda: False,
) -> Outcome:
    """Let ``team`` search until a robot reaches the target, at most ``limit`` virtual seconds.

    ``show`` is called after each measurement; when ``is_over`` returns True, the search ends with the results so far.
    """
    simulator = team.simulator
    outcome = Outcome(seed, len(simulator.names), simulator.crowd.scene.robots)
    started_at, sent = team.clock.seconds(), team.switchboard.counters["sent"]
    before = stopwatch(), simulator.moving_s, simulator.reporting_s
    team.assign()
    while outcome.seconds < limit and outcome.reach is None and not is_over():
        for _ in range(SLICES):
            if not is_over():  # half a virtual second of a large team may take a minute
                team.clock.advance(POLL_S / SLICES)
        outcome.seconds = round(team.clock.seconds() - started_at, 3)
        outcome.datagrams = team.switchboard.counters["sent"] - sent
        if simulator.crowd.target is None and outcome.seconds >= PLACE_TARGET_S:
            simulator.crowd.place_target_at_random()
        _measure(outcome, team)
        show(outcome)
    spent, moving, telling = stopwatch() - before[0], simulator.moving_s - before[1], simulator.reporting_s - before[2]
    outcome.cost = {"moving": moving, "telling": telling, "agents": spent - moving - telling}
    outcome.digest = f"{team.switchboard.digest()[:16]}-{simulator.crowd.digest()[:16]}"
    return outcome


def _measure(outcome: Outcome, team: SearchTeam) -> None:
    words, now = team.get_statuses(), outcome.seconds
    if outcome.engaged is None and len(words) == outcome.agents:
        outcome.engaged = now
    finders = [name for name, word in words.items() if word.cost is not None]
    if outcome.first is None and finders:
        outcome.first = now
    named = {word.assigned for word in words.values()}
    if outcome.agree is None:
        outcome.found = len(finders)
        if len(words) == outcome.agents and len(named) == 1 and "" not in named:
            outcome.agree, outcome.right = now, _is_nearest(team.simulator, next(iter(named)), finders)
    before = outcome.by
    if outcome.agree is not None and len(named) == 1 and "" not in named:
        outcome.by = named.pop()
    done = team.find_finisher()
    if done is not None:
        outcome.reach, outcome.by = now, done
    if outcome.by != before:
        outcome.trail.clear()  # another robot was selected
    if outcome.by:
        number = team.simulator.names.index(outcome.by)
        outcome.trail.append((float(team.simulator.crowd.x[number]), float(team.simulator.crowd.y[number])))


def _is_nearest(simulator: CrowdSimulator, chosen: str, finders: list[str]) -> bool:
    crowd, target = simulator.crowd, simulator.crowd.target
    if target is None:
        return False
    gaps = np.hypot(crowd.x - target.x, crowd.y - target.y)
    least = min((float(gaps[simulator.names.index(name)]) for name in finders), default=math.inf)
    return bool(gaps[simulator.names.index(chosen)] <= least * (1.0 + SLACK_M) + SLACK_M)


def format_table(outcome: Outcome) -> str:
    """Return the results as text, one line each."""

    def at(moment: float | None) -> str:
        return "-" if moment is None else f"{moment:.1f} s"

    seconds = max(outcome.seconds, 1e-9)
    alone = outcome.cost["moving"] + outcome.cost["telling"]
    whole = alone + outcome.cost["agents"]
    rows = [
        ("robots, agents among them", f"{outcome.bodies:,}, {outcome.agents:,}"),
        ("all agents take part", at(outcome.engaged)),
        ("the first has found the target", at(outcome.first)),
        ("all name the same agent", f"{at(outcome.agree)}, {outcome.found} had found it"),
        ("it was the nearest of those", {True: "yes", False: "NO", None: "-"}[outcome.right]),
        ("the target is reached", f"{at(outcome.reach)} by {outcome.by or 'nobody'}"),
        ("datagrams for each agent and second", f"{outcome.datagrams / seconds / max(1, outcome.agents):.1f}"),
        (
            "the simulator alone",
            f"{1e3 * alone / seconds:8.1f} ms a second: {seconds / max(alone, 1e-9):.1f} x real time",
        ),
        ("  rays, moves and controllers", f"{1e3 * outcome.cost['moving'] / seconds:8.1f} ms"),
        ("  sensor frames and pictures", f"{1e3 * outcome.cost['telling'] / seconds:8.1f} ms"),
        ("nodes, drivers and agents", f"{1e3 * outcome.cost['agents'] / seconds:8.1f} ms"),
        ("all together", f"{1e3 * whole / seconds:8.1f} ms a second: {seconds / max(whole, 1e-9):.2f} x real time"),
        ("hash", outcome.digest),
    ]
    return "\n".join(f"{name:38}{value}" for name, value in rows)


def list_kinds(team: SearchTeam, outcome: Outcome) -> dict[int, str]:
    """Return the kind of each robot that has an agent, for the map."""
    words, names = team.get_statuses(), team.simulator.names
    found = {name for name, word in words.items() if word.cost is not None}
    every = {
        body: "agents that have found it" if name in found else "agents that search" for body, name in enumerate(names)
    }
    if outcome.by:
        every[names.index(outcome.by)] = "the one that goes"
    return every
