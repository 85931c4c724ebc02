"""Simulate a crowd of robots with one controller, or a search by agents (``swarm crowd``)."""

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

from sim.robots.crowd.controller import CONTROLLERS, Controller, Readings
from sim.robots.crowd.crowd import Crowd
from sim.robots.crowd.picture import draw_svg
from sim.robots.crowd.scene import AREA_M2, CrowdScene, make_square_scene
from sim.robots.crowd.search import Outcome, SearchTeam, format_table, list_kinds, run_search
from sim.robots.scene import SceneError
from sim.robots.world import TICK_S, NotPossible

MakeTeam = Callable[[int, int, CrowdScene, Controller, Callable[[], float]], SearchTeam]
"""Creates a team from seed, number of agents, scene, the controller of the other robots, and a stopwatch."""
TARGET_DISTANCE_M = 0.6
"""Distance in metres from the centre of the target within which a robot has reached the target."""


def main(arguments: Sequence[str], make_team: MakeTeam | None = None) -> int:
    """Run the simulation; return 0 if the target was reached, 1 if not, 2 for invalid arguments."""
    parser = argparse.ArgumentParser(
        prog="python -m sim.robots.crowd" if make_team is None else "swarm crowd",
        description="Simulate a crowd of robots with one controller, or a search by hundreds of agents.",
        epilog="Example: swarm crowd --bodies 200 --seconds 30 --seed 7",
    )
    parser.add_argument("--bodies", type=int, default=1000, help="number of robots (default %(default)s)")
    parser.add_argument("--room", type=float, default=AREA_M2, help="square metres per robot (default %(default)g)")
    parser.add_argument(
        "--agents", type=int, default=0, help="number of robots that have a node and an agent (default: 0)"
    )
    parser.add_argument(
        "--controller",
        choices=sorted(CONTROLLERS),
        help="controller of the other robots (default: wander; with agents: search)",
    )
    parser.add_argument("--seed", type=int, default=1, help="seed of the random generators (default %(default)s)")
    parser.add_argument(
        "--seconds", type=float, default=60.0, help="maximum virtual time in seconds (default %(default)g)"
    )
    parser.add_argument("--picture", type=Path, help="write a map of the robots to this file, as SVG")
    parser.add_argument("--json", type=Path, help="write the results to this file, as JSON")
    args = parser.parse_args(list(arguments))
    if not 0 <= args.seed < 2**63:
        parser.error(f"--seed must be a whole number from 0 to {2**63 - 1}, not {args.seed}")
    if not 0 < args.seconds <= 86400:
        parser.error(f"--seconds must be more than 0 and at most 86400, not {args.seconds:g}")
    if args.agents and make_team is None:
        parser.error("--agents is not available here; run swarm crowd instead")
    for path in (args.picture, args.json):
        if path is not None and not path.parent.is_dir():
            parser.error(f"{path} cannot be written: the folder {path.parent} does not exist; create it")
    try:
        scene = make_square_scene(args.bodies, args.room)
        if args.agents and make_team is not None:
            return _run_search(args, scene, make_team)
        return _run_without_agents(args, scene)
    except (SceneError, NotPossible) as error:
        parser.error(str(error))


def _run_search(args: argparse.Namespace, scene: CrowdScene, make_team: MakeTeam) -> int:
    if not 1 <= args.agents <= scene.robots:
        raise SceneError(f"--agents must be from 0 to the number of robots, {scene.robots}, not {args.agents}")
    started_at = time.process_time()
    controller = CONTROLLERS[args.controller or "wander"]
    team = make_team(args.seed, args.agents, scene, controller, time.process_time)
    spent = time.process_time() - started_at
    _print(f"{args.agents} agents joined in {team.clock.seconds():.1f} virtual seconds, {spent:.1f} s of processor")
    with _interruptible() as is_over:
        outcome = run_search(team, args.seed, args.seconds, time.process_time, _print_progress, is_over)
    caption = f"{scene.robots:,} robots, {args.agents} agents, seed {args.seed}, after {outcome.seconds:.0f} s"
    _write_results(
        args, draw_svg(team.simulator.crowd, caption, list_kinds(team, outcome), outcome.trail), asdict(outcome)
    )
    _print(format_table(outcome))
    team.stop()
    return 0 if outcome.reach is not None else 1


@contextmanager
def _interruptible() -> Iterator[Callable[[], bool]]:
    """Yield a function that returns whether Ctrl-C was pressed; the second Ctrl-C interrupts as usual.

    A KeyboardInterrupt could be swallowed by the callback in which it is raised.
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


def _run_without_agents(args: argparse.Namespace, scene: CrowdScene) -> int:
    name = args.controller or "search"
    crowd = Crowd(args.seed, scene)
    crowd.place_target_at_random()
    target = crowd.target
    assert target is not None
    senses, started_at, largest_overlap = Readings(crowd), time.process_time(), 0.0
    with _interruptible() as is_over:
        while crowd.t < args.seconds and not is_over():
            crowd.commands[:] = CONTROLLERS[name](senses)
            crowd.step()
            largest_overlap = max(largest_overlap, crowd.measure_overlap())
    spent = time.process_time() - started_at
    at_it = int((((crowd.x - target.x) ** 2 + (crowd.y - target.y) ** 2) ** 0.5 < TARGET_DISTANCE_M).sum())
    rows = {
        "robots": scene.robots,
        "controller": name,
        "virtual_s": round(crowd.t, 3),
        "ms_a_step": round(1e3 * spent / max(1, crowd.ticks), 3),
        "real_time_factor": round(crowd.t / max(spent, 1e-9), 2),
        "at_the_target": at_it,
        "worst_overlap_mm": round(1e3 * largest_overlap, 2),
        "digest": crowd.digest(),
    }
    _write_results(
        args, draw_svg(crowd, f"{scene.robots:,} robots, {name}, seed {args.seed}, after {crowd.t:.0f} s"), rows
    )
    for key, value in rows.items():
        _print(f"{key.replace('_', ' '):20}{value}")
    return 0 if at_it or name not in ("search", "climb") else 1


def _print_progress(outcome: Outcome) -> None:
    if outcome.seconds % 5.0 < TICK_S:
        found = f"{outcome.found} have found it" + (f", {outcome.by} goes" if outcome.by else "")
        _print(f"{outcome.seconds:5.0f} s  {found}, {outcome.datagrams:,} datagrams")


def _write_results(args: argparse.Namespace, picture: str, rows: dict[str, object]) -> None:
    if args.picture is not None:
        args.picture.write_text(picture, encoding="utf-8")
    if args.json is not None:
        args.json.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")


def _print(line: str) -> None:
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()
