"""Takeover: trials of one executor and its stand-bys on a link of one-way 20 ms + Exp(10 ms), clocks off by 1 %."""

from __future__ import annotations

import random

from tests.invariants.radio import Air
from tests.invariants.team import Team

TASK = "t0"
DELAY, JITTER, DRIFT = 0.02, 0.01, 0.01
NEVER = 1e12


def standing(seed: int, loss: float, ttl: float, stand_bys: int = 2) -> Team:
    """A team of three council members and of agents, the first of which holds the lease."""
    dice = random.Random(f"takeover/{seed}")
    agents = 1 + stand_bys
    rates = [1.0 + dice.uniform(-DRIFT, DRIFT) for _ in range(agents + 3)]
    team = Team(f"takeover/{seed}", rates, agents, ttl, tick=NEVER)
    team.radio.air = Air(DELAY, JITTER, loss)
    team.add_task(TASK, range(agents, agents + 3))
    team.clock.advance(ttl + 0.1)
    team.bidders[0].lessee(TASK).want()
    while team.bidders[0].lessee(TASK).lease is None:
        team.clock.advance(0.05)
    for rank in range(1, agents):
        team.bidders[rank].lessee(TASK).stand_by(rank)
    team.clock.advance(ttl + dice.uniform(0.0, ttl))
    return team


def holder_of(team: Team) -> int | None:
    """Who holds the lease, by its own clock, among those that live."""
    for place in team.agents:
        if team.bidders[place].machine.is_alive and team.bidders[place].lessee(TASK).lease is not None:
            return place
    return None


def takeover(seed: int, loss: float = 0.1, ttl: float = 1.5, is_polite: bool = False) -> float:
    """Seconds from the executor's death (or leave) until another holds the lease; virtual, replayed from ``seed``."""
    team = standing(seed, loss, ttl)
    gone = holder_of(team) or 0
    began = team.clock.seconds()
    if is_polite:
        team.bidders[gone].leave(TASK, [place for place in team.agents if place != gone])
    else:
        team.kill(gone)
    while holder_of(team) in (None, gone):
        team.clock.advance(0.001)
        if team.clock.seconds() - began > 40 * ttl:
            break
    return team.clock.seconds() - began


def false_takeovers(seed: int, hours: float, loss: float = 0.2, ttl: float = 1.5) -> tuple[int, float]:
    """How often a healthy executor lost its lease in ``hours``, and the datagrams a second meanwhile."""
    team = standing(seed, loss, ttl)
    before, sent = team.referee.wins, team.radio.sent
    team.clock.advance(3600.0 * hours)
    return team.referee.wins - before, (team.radio.sent - sent) / (3600.0 * hours)


def upkeep(ttl: float = 1.5) -> float:
    """Datagrams a second, questions and answers, of an executor alone on a link that loses nothing."""
    team = standing(1, 0.0, ttl, stand_bys=0)
    sent = team.radio.sent
    team.clock.advance(60.0)
    return (team.radio.sent - sent) / 60.0
