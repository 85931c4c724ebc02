"""The command line of the yard for many: a crowd with a batch controller, or the search by the hundred."""

from __future__ import annotations

import argparse
import json
import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path

from sim.robots.crowd.controller import CONTROLLERS, Controller, Senses
from sim.robots.crowd.crowd import Crowd
from sim.robots.crowd.ground import ROOM, Ground, roomy
from sim.robots.crowd.picture import drawn
from sim.robots.crowd.search import Outcome, Team, kinds, search, table
from sim.robots.scene import SceneError
from sim.robots.world import TICK, NotPossible

MakeTeam = Callable[[int, int, Ground, Controller, Callable[[], float]], Team]
"""Seed, agents, ground, the controller of the others, a stopwatch."""
AT_IT = 0.6
"""Metres from the middle of the target within which a robot counts as standing at it."""


def main(arguments: Sequence[str], make_team: MakeTeam | None = None) -> int:
    """Run it and print the table; 0 where the target was reached, 1 where not, 2 for what cannot be run."""
    parser = argparse.ArgumentParser(
        prog="python -m sim.robots.crowd" if make_team is None else "swarm crowd",
        description=(__doc__ or "").splitlines()[0],
    )
    parser.add_argument("--bodies", type=int, default=1000, help="robots in the yard (default %(default)s)")
    parser.add_argument("--room", type=float, default=ROOM, help="square metres for each (default %(default)g)")
    parser.add_argument("--agents", type=int, default=0, help="of them driven by agents with nodes of their own")
    parser.add_argument("--controller", choices=sorted(CONTROLLERS), help="of the others (default: wander, or search)")
    parser.add_argument("--seed", type=int, default=1, help="of all dice (default %(default)s)")
    parser.add_argument("--seconds", type=float, default=60.0, help="of virtual time, at most (default %(default)g)")
    parser.add_argument("--picture", type=Path, help="write the yard from above to this file, as SVG")
    parser.add_argument("--json", type=Path, help="write what came of it to this file")
    given = parser.parse_args(list(arguments))
    if not 0 <= given.seed < 2**63:
        parser.error(f"--seed must be a whole number from 0 to {2**63 - 1}, not {given.seed}")
    if not 0 < given.seconds <= 86400:
        parser.error(f"--seconds must be more than 0 and at most 86400, not {given.seconds:g}")
    if given.agents and make_team is None:
        parser.error("--agents needs the agents, which this room does not know; say swarm crowd instead")
    for path in (given.picture, given.json):
        if path is not None and not path.parent.is_dir():
            parser.error(f"{path} cannot be written: there is no folder {path.parent}")
    try:
        ground = roomy(given.bodies, given.room)
        if given.agents and make_team is not None:
            return _search(given, ground, make_team)
        return _alone(given, ground)
    except (SceneError, NotPossible) as error:
        parser.error(str(error))


def _search(given: argparse.Namespace, ground: Ground, make_team: MakeTeam) -> int:
    if not 1 <= given.agents <= ground.bodies:
        raise SceneError(f"--agents must be from 0 to {ground.bodies}, the robots here, not {given.agents}")
    began = time.process_time()
    controller = CONTROLLERS[given.controller or "wander"]
    team = make_team(given.seed, given.agents, ground, controller, time.process_time)
    spent = time.process_time() - began
    _say(f"{given.agents} agents joined in {team.clock.seconds():.1f} virtual seconds, {spent:.1f} s of processor")
    with _interruptible() as is_over:
        outcome = search(team, given.seed, given.seconds, time.process_time, _progress, is_over)
    caption = f"{ground.bodies:,} robots, {given.agents} agents, seed {given.seed}, after {outcome.seconds:.0f} s"
    _keep(given, drawn(team.yard.crowd, caption, kinds(team, outcome), outcome.trail), asdict(outcome))
    _say(table(outcome))
    team.stop()
    return 0 if outcome.reach is not None else 1


@contextmanager
def _interruptible() -> Iterator[Callable[[], bool]]:
    """Whether somebody has pressed Ctrl-C; the second time it is an interrupt as usual.

    An exception would be caught by whichever callback it happens to meet, and nothing would end.
    """
    pressed: list[int] = []
    usual = signal.getsignal(signal.SIGINT)

    def press(number: int, _frame: object) -> None:
        pressed.append(number)
        signal.signal(signal.SIGINT, usual)

    signal.signal(signal.SIGINT, press)
    try:
        yield lambda: bool(pressed)
    finally:
        signal.signal(signal.SIGINT, usual)


def _alone(given: argparse.Namespace, ground: Ground) -> int:
    name = given.controller or "search"
    crowd = Crowd(given.seed, ground)
    crowd.place_target_at_random()
    target = crowd.target
    assert target is not None
    senses, began, worst = Senses(crowd), time.process_time(), 0.0
    with _interruptible() as is_over:
        while crowd.t < given.seconds and not is_over():
            crowd.wish[:] = CONTROLLERS[name](senses)
            crowd.step()
            worst = max(worst, crowd.overlap())
    spent = time.process_time() - began
    at_it = int((((crowd.x - target.x) ** 2 + (crowd.y - target.y) ** 2) ** 0.5 < AT_IT).sum())
    rows = {
        "robots": ground.bodies,
        "controller": name,
        "virtual_s": round(crowd.t, 3),
        "ms_a_step": round(1e3 * spent / max(1, crowd.ticks), 3),
        "real_time_factor": round(crowd.t / max(spent, 1e-9), 2),
        "at_the_target": at_it,
        "worst_overlap_mm": round(1e3 * worst, 2),
        "digest": crowd.digest(),
    }
    _keep(given, drawn(crowd, f"{ground.bodies:,} robots, {name}, seed {given.seed}, after {crowd.t:.0f} s"), rows)
    for key, value in rows.items():
        _say(f"{key.replace('_', ' '):20}{value}")
    return 0 if at_it or name not in ("search", "climb") else 1


def _progress(outcome: Outcome) -> None:
    if outcome.seconds % 5.0 < TICK:
        found = f"{outcome.found} have found it" + (f", {outcome.by} goes" if outcome.by else "")
        _say(f"{outcome.seconds:5.0f} s  {found}, {outcome.datagrams:,} datagrams")


def _keep(given: argparse.Namespace, picture: str, rows: dict[str, object]) -> None:
    if given.picture is not None:
        given.picture.write_text(picture, encoding="utf-8")
    if given.json is not None:
        given.json.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")


def _say(line: str) -> None:
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()
