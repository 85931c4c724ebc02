"""The result of one strategy on a mission: the owner of each task, and the cost of the agreement."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

from benchmarks.consensus.cbba_run import CbbaRun, run_meetings
from benchmarks.consensus.decider import BIDS_BY_NAME, DECIDERS, EXCHANGING, MEETINGS, Owners
from benchmarks.consensus.mission import Mission

MAX_FULL_BIDDERS = 100
FEW_BIDS = 40
"""Bids of each agent in missions of more than ``MAX_FULL_BIDDERS`` agents, in which all bids would be a million."""
BID_KB = 0.012
"""Size of an encoded bid in kB: its task, its cost, and its share of the message overhead."""
MEETING_KB = 0.03


@dataclass(frozen=True)
class Outcome:
    """The owner of each task; messages and kB are averages per agent, ``cpu_ms`` is the sum over all agents."""

    owners: Owners
    messages: float
    kB: float  # noqa: N815 the unit's spelling
    rounds: float
    cpu_ms: float


def make_outcome(name: str, mission: Mission, cbba_run: CbbaRun | None = None) -> Outcome:
    """Return the result of a strategy; strategies that do not collect bids at one node use ``cbba_run``, if given."""
    found = (
        make_collected_outcome(name, mission)
        if cbba_run is None or name not in EXCHANGING
        else make_cbba_outcome(cbba_run)
    )
    if name != MEETINGS:
        return found
    owners, messages = run_meetings(mission, found.owners)
    return replace(
        found,
        owners=owners,
        messages=found.messages + messages,
        kB=found.kB + MEETING_KB * messages,
        rounds=found.rounds + messages,
    )


def make_cbba_outcome(cbba_run: CbbaRun) -> Outcome:
    """Return the agreement between the agents; if two agents claim a task, the first one owns it."""
    owners = {task: agents[0] for task, agents in cbba_run.owners.items()}
    return Outcome(owners, cbba_run.messages, cbba_run.message_bytes / 1000.0, cbba_run.rounds, cbba_run.cpu_s * 1000.0)


def make_collected_outcome(name: str, mission: Mission) -> Outcome:
    """Return the result with bids collected at one node: each agent sends and receives one message per round.

    If tasks have no bids, the agents bid for these tasks in a further round, and all tasks are decided again.
    """
    most = BIDS_BY_NAME.get(name, mission.tasks if mission.agents <= MAX_FULL_BIDDERS else FEW_BIDS)
    took, times, holes = 0.0, 0, set[str]()
    while True:
        times += 1
        reports = mission.make_reports(mission.alive, most, holes)
        started_at = time.process_time()
        owners = DECIDERS[name](mission, reports)
        took += (time.process_time() - started_at) * 1000.0
        more = set(mission.task_positions) - set(owners)
        if more <= holes:
            each = len(reports) / len(mission.alive)
            return Outcome(owners, 2.0 * times, BID_KB * each, 2.0 * times, took)
        holes |= more
