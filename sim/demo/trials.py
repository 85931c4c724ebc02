"""Repeat both experiments of the thesis with many seeds; write a table, and pictures of each phase.

``swarm trials --count 20 --seed 1`` runs real nodes, agents and drivers and the robot simulator in virtual time;
``--real 3`` adds runs with real processes (``sim.demo``).  The caller provides the team.
"""

from __future__ import annotations

import argparse
import json
import math
import multiprocessing
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Protocol

from sim.demo.experiment import Experiment

POLL_S = 0.032
"""Virtual seconds between two evaluations of the team: the interval of sensor frames."""
LIMIT_S = 120.0
SETTLE_S = 1.0


class DemoTeam(Protocol):
    """A team in virtual time (``SimulatedTeam`` of package ``swarmnode``)."""

    clock: Any
    switchboard: Any
    simulator: Any

    def run_demo(self) -> str:
        """Assign the demonstration's task."""

    def state(self) -> dict[str, Any]:
        """Return the state that the page shows."""

    def get_true_state(self) -> dict[str, Any]:
        """Return the true positions of the robots and the target."""

    def scatter(self, seed: int) -> None:
        """Move the dogs to random positions."""

    def kill(self, name: str) -> None:
        """Kill a node."""

    def stop(self) -> None:
        """Stop the team."""


MakeTeam = Callable[[int], DemoTeam]


@dataclass
class Outcome:
    """The result of one trial; times are in seconds since the task was assigned, ``takeover`` since the kill.

    ``found`` is whether every dog reported before the task ended, and ``agreed`` whether all agents selected the same
    dog. ``right`` is whether the nearest dog approached the target, and ``held`` whether all conditions of the
    experiment are met.
    """

    seed: int
    experiment: int
    held: bool = False
    found: bool = False
    agreed: bool = False
    right: bool = False
    by: str = ""
    killed: str = ""
    find: float | None = None
    agree: float | None = None
    reach: float | None = None
    takeover: float | None = None
    digest: str = ""
    broken: list[str] = field(default_factory=list)


def run_trial(make_team: MakeTeam, experiment: int, seed: int, pictures: Path | None = None) -> Outcome:
    """Run one experiment from ``seed``; if the folder ``pictures`` is given, draw a picture of each phase into it."""
    team = make_team(seed)
    team.scatter(seed)
    draw = _make_draw(team, pictures, experiment, seed)
    draw("1-without-target", "The dogs in the yard, no target yet")
    started_at = team.clock.seconds()
    run = Experiment(f"experiment {experiment}", team.run_demo(), experiment == 2, started_at)
    outcome = Outcome(seed, experiment)
    while not run.is_over and team.clock.seconds() - started_at < LIMIT_S:
        team.clock.advance(POLL_S)
        state, truth = team.state(), team.get_true_state()
        _record_times(outcome, state, truth, team.clock.seconds() - started_at, draw)
        killed = run.update(team.clock.seconds(), state, truth)
        if killed:
            draw("5-lost", f"{killed} is lost on its way")
            team.kill(killed)
    draw("6-reached", f"{run.by or 'nobody'} stands at the target")
    team.clock.advance(SETTLE_S)
    outcome.digest = team.switchboard.digest()
    team.stop()
    checks = run.list_checks()
    outcome.by, outcome.killed, outcome.reach, outcome.takeover = run.by, run.killed, run.duration_s, run.takeover_s
    outcome.right = bool(checks) and checks[-1].is_met and "nearest" in checks[-1].description
    outcome.broken = [check.description for check in checks if not check.is_met]
    outcome.held = run.has_passed
    return outcome


Draw = Callable[[str, str], None]


def _record_times(outcome: Outcome, state: dict[str, Any], truth: dict[str, Any], now: float, draw: Draw) -> None:
    """Record the times at which all dogs have found the target, and at which all agents have selected the same dog."""
    group = state["groups"][0] if state["groups"] else None
    if truth["target"] is not None:
        draw("2-with-target", "The target is placed while they search")
    if group is None:
        return
    members = group["members"]
    if members and outcome.find is None and all(m["cost"] is not None for m in members):
        outcome.find, outcome.found = now, True
        draw("3-found", "All dogs have found the target")
    if members and outcome.agree is None and group["assigned"] and group["agree"] == group["of"]:
        outcome.agree, outcome.agreed = now, True
        draw("4-approach", f"All agree: {group['assigned']} goes")


def _make_draw(team: DemoTeam, folder: Path | None, experiment: int, seed: int) -> Draw:
    if folder is None:
        return lambda phase, caption: None
    from sim.robots.picture import draw_map

    drawn: set[str] = set()

    def draw(phase: str, caption: str) -> None:
        if phase not in drawn:
            drawn.add(phase)
            path = folder / f"experiment{experiment}-seed{seed}-{phase}.png"
            path.write_bytes(draw_map(team.get_true_state(), caption=caption))

    return draw


def percentile(values: Sequence[float], share: float) -> float:
    """Return the smallest of ``values`` such that at least the share ``share`` of all values does not exceed it."""
    ordered = sorted(values)
    return ordered[max(0, math.ceil(share * len(ordered)) - 1)]


def format_table(outcomes: Iterable[Outcome]) -> str:
    """Return one line per experiment: counts of held, found, agreed and right; times as median (95th percentile)."""
    rows = [f"{'':12}{'trials':>7}{'held':>7}{'found':>7}{'agreed':>8}{'right':>7}"]
    rows[0] += "".join(f"{name:>16}" for name in ("find s", "agree s", "reach s", "take over s"))
    every = list(outcomes)
    for number in sorted({o.experiment for o in every}):
        some = [o for o in every if o.experiment == number]
        counts = [sum(getattr(o, name) for o in some) for name in ("held", "found", "agreed", "right")]
        cells = "".join(f"{n:>{width}}" for n, width in zip(counts, (7, 7, 8, 7), strict=True))
        row = f"experiment {number}{len(some):>7}{cells}"
        for name in ("find", "agree", "reach", "takeover"):
            times = [t for o in some if (t := getattr(o, name)) is not None]
            cell = f"{statistics.median(times):.2f} ({percentile(times, 0.95):.2f})" if times else "-"
            row += f"{cell:>16}"
        rows.append(row)
    return "\n".join(rows)


def _run_job(job: tuple[MakeTeam, int, int, Path | None]) -> Outcome:
    make_team, experiment, seed, pictures = job
    return run_trial(make_team, experiment, seed, pictures)


def run_real(count: int, seed: int, run_dir: Path) -> list[bool]:
    """Run both experiments with real processes ``count`` times; return for each run whether it passed."""
    held = []
    for number in range(count):
        command = [sys.executable, "-m", "sim.demo", "--headless", "--seed", str(seed + number), "--run-dir"]
        held.append(subprocess.run([*command, str(run_dir / f"real{number}")], check=False).returncode == 0)
    return held


def parse_count(text: str) -> int:
    """Parse a non-negative integer of the command line."""
    if not (text.isdecimal() and len(text) <= 9):
        raise argparse.ArgumentTypeError(f"must be a whole number of at least 0, is {text!r}")
    return int(text)


def main(arguments: Sequence[str], make_team: MakeTeam) -> int:
    """Run the command line; returns 0 if every trial passed."""
    parser = argparse.ArgumentParser(
        prog="swarm trials",
        description="Repeat both experiments of the thesis with many seeds; write a table, and pictures of each phase.",
        epilog="Example: swarm trials --count 20 --seed 1",
    )
    parser.add_argument(
        "--count", type=parse_count, default=20, help="trials of each experiment in virtual time (default: %(default)s)"
    )
    parser.add_argument("--seed", type=int, default=1, help="seed of the first trial (default: %(default)s)")
    parser.add_argument(
        "--real",
        type=parse_count,
        default=0,
        help="runs of both experiments with real processes (default: %(default)s)",
    )
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("run/trials"),
        help="folder for the report and the pictures (default: %(default)s)",
    )
    parser.add_argument("--pictures", type=parse_count, default=1, help="number of seeds for which pictures are drawn")
    parser.add_argument("--jobs", type=parse_count, default=os.cpu_count() or 1, help="parallel trials")
    args = parser.parse_args(list(arguments))
    try:
        args.out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        parser.error(f"--out: cannot create {args.out} ({error.strerror}); choose another folder")
    jobs = [
        (make_team, experiment, args.seed + n, args.out if n < args.pictures else None)
        for n in range(args.count)
        for experiment in (1, 2)
    ]
    outcomes = []
    started_at = time.monotonic()
    with ExitStack() as stack:
        spread: Callable[..., Iterable[Outcome]] = map
        if args.jobs > 1:
            # Forking a process with threads may deadlock.
            spawn = multiprocessing.get_context("spawn")
            spread = stack.enter_context(ProcessPoolExecutor(args.jobs, spawn)).map
        for outcome in spread(_run_job, jobs):
            outcomes.append(outcome)
            text = "ok  " if outcome.held else "FAIL"
            broken = f"  ({'; '.join(outcome.broken)})" if outcome.broken else ""
            line = f"{len(outcomes):4}/{len(jobs)} {text} experiment {outcome.experiment} seed {outcome.seed}"
            sys.stdout.write(f"{line}: {outcome.by or 'nobody'} reached it{broken}\n")
            sys.stdout.flush()
    (args.out / "trials.json").write_text(json.dumps([asdict(o) for o in outcomes], indent=1), encoding="utf-8")
    sys.stdout.write(f"\n{format_table(outcomes)}\n")
    virtual = sum(o.reach or 0.0 for o in outcomes)
    spent = time.monotonic() - started_at
    sys.stdout.write(f"{virtual:.0f} s of team time in {spent:.0f} s; report and pictures in {args.out}\n")
    held = run_real(args.real, args.seed, args.out)
    if held:
        sys.stdout.write(f"real processes: {sum(held)} of {len(held)} runs held, both experiments each\n")
    return 0 if all(o.held for o in outcomes) and all(held) else 1
