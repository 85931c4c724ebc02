"""Outcome: who has each task of a mission by one strategy, and what it took to agree on that."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

from benchmarks.consensus.decider import DECIDERS, MEETINGS, NAMED, TALKED, Owners
from benchmarks.consensus.mission import Mission
from benchmarks.consensus.talk import Talked, after_meetings

ALL = 100
FEW = 40
"""Bids of each agent beyond ``ALL`` agents, where all would be a million."""
BID_KB = 0.012
"""A bid on its way: its task, its cost, and its share of what is around it."""
MEETING_KB = 0.03


@dataclass(frozen=True)
class Outcome:
    """Who has each task; messages and kB are those of an agent, ``cpu_ms`` is of all that reckon."""

    owners: Owners
    messages: float
    kB: float  # noqa: N815 the unit is written so
    rounds: float
    cpu_ms: float


def outcome(name: str, mission: Mission, talk: Talked | None = None) -> Outcome:
    """What a strategy makes of a mission; those that need no gathering by what the agents told each other, if given."""
    found = gathered(name, mission) if talk is None or name not in TALKED else among_themselves(talk)
    if name != MEETINGS:
        return found
    owners, messages = after_meetings(mission, found.owners)
    return replace(
        found,
        owners=owners,
        messages=found.messages + messages,
        kB=found.kB + MEETING_KB * messages,
        rounds=found.rounds + messages,
    )


def among_themselves(talk: Talked) -> Outcome:
    """Where the agents agree without a place to gather at; of two that both believe to have a task, the first."""
    owners = {task: agents[0] for task, agents in talk.owners.items()}
    return Outcome(owners, talk.messages, talk.octets / 1000.0, talk.rounds, talk.cpu_s * 1000.0)


def gathered(name: str, mission: Mission) -> Outcome:
    """Where bids are gathered at one place and answered: each agent sends one message a time, and gets one.

    What nobody bid for is bid for by all who have not, and everything is decided again.
    """
    most = NAMED.get(name, mission.tasks if mission.agents <= ALL else FEW)
    took, times, holes = 0.0, 0, set[str]()
    while True:
        times += 1
        reports = mission.reports(mission.alive, most, holes)
        began = time.process_time()
        owners = DECIDERS[name](mission, reports)
        took += (time.process_time() - began) * 1000.0
        more = set(mission.places) - set(owners)
        if more <= holes:
            each = len(reports) / len(mission.alive)
            return Outcome(owners, 2.0 * times, BID_KB * each, 2.0 * times, took)
        holes |= more
