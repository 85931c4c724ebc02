"""One failure in virtual time, with the real node, agent, driver and robot simulator (``swarmnode.rehearsal``)."""

from __future__ import annotations

import random
from dataclasses import replace

from twisted.internet.defer import Deferred

from agents.catalogue import task_named
from benchmarks.takeover.cause import LOOK_S, PHASE_S, WEB, WITNESSES, Cause, Judge, Trial
from middleware.entangled.network.switchboard import Weather
from middleware.entangled.record import Record
from middleware.tasks.task import Task, outcome_of
from swarmnode.rehearsal import VirtualTeam

WEATHER = Weather(delay_s=0.03, jitter_s=0.01)
"""The one-way delay is 20 to 40 ms, as on a busy wireless network."""
START_S, LIMIT_S, AFTER_S = 20.0, 25.0, 1.0


def trial(cause: Cause, seed: int, loss: float = 0.1) -> Trial:
    """Inject a fault into the acting robot of the team of ``seed``; ``loss`` is the share of lost datagrams."""
    rng = random.Random(f"takeover/{cause.value}/{seed}")
    others = (WEB, *WITNESSES) if cause is Cause.TRIPLE_KILL else ()
    team = VirtualTeam(seed, 0.1, others=others)
    team.scatter(seed)
    asker = WEB if others else VirtualTeam.BOOTSTRAP
    node = team.services[asker].assembly.node
    task = replace(task_named("turn-around", f"turn{seed}", 0.0), waiting_period=1.0)
    if cause is Cause.TRIPLE_KILL:
        task = replace(task, tolerates=3)
    submitted: list[Task] = []
    Deferred.fromCoroutine(node.submit(task)).addCallback(submitted.append)
    team.board.weather = replace(WEATHER, loss=loss)
    watcher = team.services[WITNESSES[0] if others else asker].assembly.node
    group: list[Record] = []
    watcher.watch_group(task.task_id, lambda records: group.__setitem__(slice(None), records))
    lost = _wait_for_motion(team)
    if lost is None:
        team.stop()
        return Trial(cause.value, seed, "", "", False, None, 0, 0)
    team.clock.advance(rng.uniform(*PHASE_S))
    _inject_fault(team, cause, lost)
    judge = Judge(cause, seed, lost, team.clock.seconds(), rng, LIMIT_S, AFTER_S)
    while not judge.is_over(team.clock.seconds()):
        team.clock.advance(LOOK_S)
        now = team.clock.seconds()
        if judge.thaws(now):
            team.thaw(lost)
        judge.look(now, _moving_robots(team), outcome_of(submitted[0], group))
    team.stop()
    return judge.verdict()


def _moving_robots(team: VirtualTeam) -> list[str]:
    return [name for name, dog in team.yard.world.dogs.items() if dog.is_moving]


def _wait_for_motion(team: VirtualTeam) -> str | None:
    end = team.clock.seconds() + START_S
    while team.clock.seconds() < end:
        team.clock.advance(LOOK_S)
        moving = _moving_robots(team)
        if moving:
            return moving[0]
    return None


def _inject_fault(team: VirtualTeam, cause: Cause, name: str) -> None:
    match cause:
        case Cause.CRASH:
            team.kill(name)
        case Cause.FREEZE:
            team.freeze(name)
        case Cause.LOST_RADIO:
            team.silence(name)
        case Cause.ONE_WAY_RADIO:
            team.silence(name, one_way=True)
        case Cause.LOST_LINK:
            team.unplug(name)
        case Cause.POLITE_LEAVE:
            team.services[name].stopService()
        case Cause.TRIPLE_KILL:
            for each in (name, team.BOOTSTRAP, WEB):
                team.kill(each)
