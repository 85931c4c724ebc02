"""Measure a large simulated world: rays, motion and controllers of 3 to 10,000 robots, attached agents, and a task.

Started by ``make bench-crowd``. Times are in milliseconds of processor time, so other processes on the machine have
little effect. Each size runs in a separate process, so that its memory can be measured.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.measure import MIB, read_memory_bytes

TICK_MS = 32.0
POLL_S = 2.0
"""Virtual seconds for which attached agents are measured, after they have settled."""
SETTLE_S = 4.0
TASK_S = 3.0
"""Virtual seconds after the assignment of a task for which its datagrams are counted."""
ARGOS = "ARGoS is quoted with 10,000 e-pucks at 1.7 x real time, by many threads on a machine of 2012"


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and print; return 1 if the simulation is slower than real time."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.crowd", description=(__doc__ or "").splitlines()[0])
    parser.add_argument(
        "--bodies", default="3,100,1000,10000", help="numbers of robots, comma-separated (default %(default)s)"
    )
    parser.add_argument(
        "--agents", type=int, default=100, help="agents attached to 1,000 robots; 0: none (default %(default)s)"
    )
    parser.add_argument(
        "--tasks", default="10,20,40", help="numbers of agents that share a task (default %(default)s; 0: none)"
    )
    parser.add_argument("--controller", default="search", help="controller of all robots (default %(default)s)")
    parser.add_argument("--seconds", type=float, default=3.0, help="processor time for each size (default %(default)s)")
    parser.add_argument("--out", type=Path, help="write the figures to this file, as JSON")
    parser.add_argument("--one", type=int, help=argparse.SUPPRESS)
    args = parser.parse_args(arguments)
    sizes = args.bodies.split(",")
    if not all(size.isdecimal() and 1 <= int(size) <= 100_000 for size in sizes):
        parser.error(f"--bodies must be comma-separated numbers from 1 to 100000, not {args.bodies!r}")
    shared = args.tasks.split(",")
    if not all(size.isdecimal() and int(size) <= 1000 for size in shared):
        parser.error(f"--tasks must be comma-separated numbers from 0 to 1000, not {args.tasks!r}")
    if not 0.1 <= args.seconds <= 600 or not 0 <= args.agents <= 1000:
        parser.error("--seconds must be 0.1 to 600, and --agents 0 to 1000")
    if args.one is not None:
        sys.stdout.write(json.dumps(_measure_robots(args.one, args.controller, args.seconds)) + "\n")
        return 0
    sys.stdout.write(
        f"{'robots':>8}{'rays ms':>9}{'moves':>9}{'control':>9}{'step ms':>9}{'x real time':>13}{'MiB':>8}\n"
    )
    rows = []
    for size in sizes:
        command = [sys.executable, "-m", "benchmarks.crowd", "--one", size, "--controller", args.controller]
        child = subprocess.run(
            [*command, "--seconds", str(args.seconds)], stdout=subprocess.PIPE, text=True, check=True
        )
        row = json.loads(child.stdout)
        rows.append(row)
        cells = (f"{row[key]:9.3f}" for key in ("rays", "moves", "control", "step"))
        _print_line(f"{row['robots']:>8,}{''.join(cells)}{row['factor']:13.1f}{row['mib']:8.1f}")
    _print_line(
        f"8 rays each, steps of 32 ms, all {args.controller}, one thread; MiB: more than the program without robots"
    )
    _print_line(f"{ARGOS}: the same order, on one core")
    figures: dict[str, Any] = {"alone": rows}
    if args.agents:
        figures["attached"] = _measure_agents(args.agents)
    figures["tasks"] = _measure_tasks([int(size) for size in shared if int(size)])
    if args.out is not None:
        args.out.write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")
    return 0 if all(row["factor"] >= 1.0 for row in rows) else 1


def _measure_robots(bodies: int, controller: str, seconds: float) -> dict[str, float]:
    """Measure the simulation without agents: the mean time of a step and of its parts, including neighbour search."""
    from sim.robots.crowd.controller import CONTROLLERS, Readings
    from sim.robots.crowd.crowd import Crowd
    from sim.robots.crowd.scene import make_square_scene

    class Timed(Crowd):
        rays = 0.0

        def cast_rays(self) -> Any:
            started_at = time.process_time()
            met = super().cast_rays()
            self.rays = 1e3 * (time.process_time() - started_at)
            return met

    before = read_memory_bytes("VmHWM") / MIB
    crowd = Timed(1, make_square_scene(bodies))
    crowd.place_target_at_random()
    senses, control = Readings(crowd), CONTROLLERS[controller]
    parts: dict[str, list[float]] = {"rays": [], "moves": [], "control": [], "step": []}
    end = time.process_time() + seconds
    while time.process_time() < end or len(parts["step"]) < 20:
        started_at = time.process_time()
        crowd.commands[:] = control(senses)
        controlled = time.process_time()
        crowd.step()
        stepped = time.process_time()
        parts["step"].append(1e3 * (stepped - started_at))
        parts["control"].append(1e3 * (controlled - started_at))
        parts["rays"].append(crowd.rays)
        parts["moves"].append(1e3 * (stepped - controlled) - crowd.rays)
    means = {key: statistics.fmean(costs) for key, costs in parts.items()}
    return {
        "robots": bodies,
        **means,
        "factor": TICK_MS / means["step"],
        "mib": read_memory_bytes("VmHWM") / MIB - before,
    }


def _measure_agents(agents: int) -> dict[str, float]:
    """Measure agents with nodes and drivers on 1,000 robots without a task, with and without cameras."""
    from sim.robots.crowd.scene import make_square_scene
    from swarmnode.crowd import CAMERA_FPS, CrowdTeam

    started_at = time.process_time()
    team = CrowdTeam(1, agents, make_square_scene(max(1000, agents)), stopwatch=time.process_time)
    team.clock.advance(SETTLE_S)
    figures = {"agents": float(agents), "joining": time.process_time() - started_at}
    _print_line(
        f"\n{agents} agents attached to {team.simulator.crowd.scene.robots:,} robots, no task; ms a virtual second"
    )
    _print_line(f"{'':24}{'moves, rays':>12}{'telling':>9}{'agents':>9}{'yard alone':>13}{'all':>9}{'datagrams':>11}")
    for part, fps in ((f"{CAMERA_FPS:g} pictures a second", CAMERA_FPS), ("no camera", 0.0)):
        for service in team.services.values():
            driver: Any = service.assembly.driver
            if driver is not None:
                driver.set_camera_fps(fps)
        team.clock.advance(0.5)
        moving, telling, sent = team.simulator.moving_s, team.simulator.reporting_s, team.switchboard.counters["sent"]
        started_at = time.process_time()
        team.clock.advance(POLL_S)
        whole = (time.process_time() - started_at) / POLL_S
        moving, telling = (team.simulator.moving_s - moving) / POLL_S, (team.simulator.reporting_s - telling) / POLL_S
        rate = (team.switchboard.counters["sent"] - sent) / POLL_S
        yard = moving + telling
        costs = "".join(f"{1e3 * cost:{wide}.0f}" for cost, wide in ((moving, 12), (telling, 9), (whole - yard, 9)))
        _print_line(f"{part:24}{costs}{1 / yard:11.1f} x{1 / whole:7.2f} x{rate:11,.0f}")
        figures |= {f"{part}, yard": yard, f"{part}, all": whole, f"{part}, datagrams": rate}
    team.stop()
    return figures


def _measure_tasks(sizes: Sequence[int]) -> list[dict[str, float]]:
    """Count the datagrams of the agents after the assignment of one task, and in the same time without a task."""
    from sim.robots.crowd.scene import make_square_scene
    from swarmnode.crowd import CrowdTeam

    rows = []
    if sizes:
        _print_line(
            f"\n{'agents':>8}{'at the task':>13}{'datagrams':>11}{'without':>9}   in the first {TASK_S:g} s of a task"
        )
    for agents in sizes:
        team = CrowdTeam(1, agents, make_square_scene(max(100, agents)))
        team.clock.advance(TASK_S)
        sent = []
        for begin in (lambda: None, team.assign):
            before = team.switchboard.counters["sent"]
            begin()
            team.clock.advance(TASK_S)
            sent.append(float(team.switchboard.counters["sent"] - before))
        rows.append(
            {"agents": float(agents), "taking part": float(len(team.get_statuses())), "idle": sent[0], "task": sent[1]}
        )
        _print_line(f"{agents:>8}{len(team.get_statuses()):>13}{sent[1]:>11,.0f}{sent[0]:>9,.0f}")
        team.stop()
    return rows


def _print_line(line: str) -> None:
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())
