"""One failure in virtual time, with the real node, agent, driver and robot simulator (``swarmnode.simulated_team``)."""

from __future__ import annotations

import random
from dataclasses import replace

from twisted.internet.defer import Deferred

from agents.catalogue import create_task
from benchmarks.takeover.cause import PHASE_S, POLL_S, WEB, WITNESSES, Cause, TakeoverObserver, Trial
from middleware.entangled.network.switchboard import LinkConditions
from middleware.entangled.record import Record
from middleware.tasks.task import Task, find_outcome
from swarmnode.simulated_team import SimulatedTeam

LINK_CONDITIONS = LinkConditions(delay_s=0.03, jitter_s=0.01)
"""The one-way delay is 20 to 40 ms, as on a busy wireless network."""
START_S, LIMIT_S, AFTER_S = 20.0, 25.0, 1.0


def run_trial(cause: Cause, seed: int, loss: float = 0.1) -> Trial:
    """Inject a fault into the acting robot of the team of ``seed``; ``loss`` is the share of lost datagrams."""
    rng = random.Random(f"takeover/{cause.value}/{seed}")
    others = (WEB, *WITNESSES) if cause is Cause.TRIPLE_KILL else ()
    team = SimulatedTeam(seed, 0.1, others=others)
    team.scatter(seed)
    requester = WEB if others else SimulatedTeam.BOOTSTRAP
    node = team.services[requester].assembly.node
    task = replace(create_task("turn-around", f"turn{seed}", 0.0), waiting_period=1.0)
    if cause is Cause.TRIPLE_KILL:
        task = replace(task, tolerates=3)
    submitted: list[Task] = []
    Deferred.fromCoroutine(node.submit(task)).addCallback(submitted.append)
    team.switchboard.conditions = replace(LINK_CONDITIONS, loss=loss)
    watcher = team.services[WITNESSES[0] if others else requester].assembly.node
    group: list[Record] = []
    watcher.watch_group(task.task_id, lambda records: group.__setitem__(slice(None), records))
    lost = _wait_for_motion(team)
    if lost is None:
        team.stop()
        return Trial(cause.value, seed, "", "", False, None, 0, 0)
    team.clock.advance(rng.uniform(*PHASE_S))
    _inject_fault(team, cause, lost)
    observer = TakeoverObserver(cause, seed, lost, team.clock.seconds(), rng, LIMIT_S, AFTER_S)
    while not observer.is_over(team.clock.seconds()):
        team.clock.advance(POLL_S)
        now = team.clock.seconds()
        if observer.take_thaw(now):
            team.unfreeze(lost)
        observer.record(now, _moving_robots(team), find_outcome(submitted[0], group))
    team.stop()
    return observer.make_trial()


def _moving_robots(team: SimulatedTeam) -> list[str]:
    return [name for name, dog in team.simulator.world.dogs.items() if dog.is_moving]


def _wait_for_motion(team: SimulatedTeam) -> str | None:
    end = team.clock.seconds() + START_S
    while team.clock.seconds() < end:
        team.clock.advance(POLL_S)
        moving = _moving_robots(team)
        if moving:
            return moving[0]
    return None


def _inject_fault(team: SimulatedTeam, cause: Cause, name: str) -> None:
    match cause:
        case Cause.CRASH:
            team.kill(name)
        case Cause.FREEZE:
            team.freeze(name)
        case Cause.LOST_RADIO:
            team.block_datagrams(name)
        case Cause.ONE_WAY_RADIO:
            team.block_datagrams(name, one_way=True)
        case Cause.LOST_LINK:
            team.block_robot_link(name)
        case Cause.POLITE_LEAVE:
            team.services[name].stopService()
        case Cause.TRIPLE_KILL:
            for each in (name, team.BOOTSTRAP, WEB):
                team.kill(each)
