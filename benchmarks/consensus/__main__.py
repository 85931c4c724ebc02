"""Run the strategies on the missions from the command line.

The cost is compared with the exact optimum of the same mission. Messages, rounds and time are those of CBBA between the
agents, or of bids that are collected at one node. The exit code is 1 if a target is missed.
"""

from __future__ import annotations

import argparse
import gc
import json
import math
import sys
import time
from pathlib import Path
from statistics import fmean, median
from typing import Any

from benchmarks.consensus.cbba_run import ROUND_S, run_cbba
from benchmarks.consensus.decider import DECIDERS, EXCHANGING, LIMITED_OPTIMUM, MEETINGS, Owners
from benchmarks.consensus.mission import Mission
from benchmarks.consensus.oracle import measure_routes, search_routes, solve_assignment
from benchmarks.consensus.outcome import MAX_FULL_BIDDERS, make_collected_outcome, make_outcome
from benchmarks.consensus.plot import draw_svg
from middleware.consensus.strategies import hungarian
from middleware.consensus.strategies.sequential import plan_routes

SIZES = (3, 10, 30, 100, 300, 1000)
QUICK_SIZES = (3, 10, 30, 100)
SEEDS, QUICK_SEEDS = 10, 2
MAX_AGENTS = 3000
"""Maximum total number of agents in the missions of one size: the cost of a mission grows with their square."""
FAILED_PERCENT = 10
ROUTE_SIZES = ((3, 3), (3, 6), (10, 10), (10, 20), (50, 50), (50, 100))
ROUTE_SEARCH_S, QUICK_ROUTE_SEARCH_S = 0.08, 0.01
"""Seconds of the search for the shortest routes, for each task."""


def main() -> int:
    """Run the measurements that the arguments select, print them, and write them."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.consensus", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="up to 100 agents and two missions; ends within 20 s")
    parser.add_argument(
        "--sizes", default="", help=f"numbers of agents, comma-separated (default {','.join(map(str, SIZES))})"
    )
    parser.add_argument(
        "--seeds", type=int, default=0,
        help=f"missions of each size, at most {MAX_AGENTS} agents in total (default {SEEDS}, quick {QUICK_SEEDS})",
    )  # fmt: skip
    parser.add_argument("--out", type=Path, help="write everything as JSON")
    parser.add_argument("--plot", type=Path, help="draw the costs as SVG")
    args = parser.parse_args()
    sizes = [int(n) for n in args.sizes.split(",")] if args.sizes else list(QUICK_SIZES if args.quick else SIZES)
    seeds = args.seeds or (QUICK_SEEDS if args.quick else SEEDS)
    gc.disable()  # the garbage collector would scan a thousand agents repeatedly and find no garbage
    started_at = time.monotonic()
    print(f"{'agents':>6s} {'missions':>8s} {'strategy':24s} {'cost':>6s} {'failed':>7s} {'moved':>6s} {'messages':>8s}"
          f" {'kB':>6s} {'rounds':>6s} {'agree s':>7s} {'CPU ms':>8s}")  # fmt: skip
    rows = []
    for size in sizes:
        for row in measure_size(size, range(1, 1 + max(1, min(seeds, MAX_AGENTS // size)))):
            rows.append(row)
            print(format_row(row), flush=True)
    ways = compare_routes(1 if args.quick else 5, QUICK_ROUTE_SEARCH_S if args.quick else ROUTE_SEARCH_S)
    found = check_targets(rows, ways, range(1, 1 + seeds))
    print(f"\nRoutes through several tasks, sequential, relative to the best known ({ways['by']}), and the maximum:")
    for key, ratio in ways["ratios"].items():
        print(f"    {key:12s} {ratio:.3f} {ways['worst'][key]:.3f}")
    print(f"\nTargets (optimum by {rows[0]['by']}):")
    for target in found:
        word = "yes" if target["is_met"] else "NO"
        print(f"    {word:3s}  {target['what']:58s} {target['is']:9.3f} (at most {target['most']:g})")
    print(f"\nThe run took {time.monotonic() - started_at:.0f} s, {time.process_time():.0f} s of processor time.")
    if args.out:
        args.out.write_text(json.dumps({"rows": rows, "ways": ways, "targets": found}, indent=1), encoding="utf-8")
    if args.plot:
        args.plot.write_text(draw_svg(rows), encoding="utf-8")
    return int(not all(target["is_met"] for target in found))


def measure_size(size: int, seeds: range) -> list[dict[str, Any]]:
    """Return a row for every strategy on the missions of one size."""
    found = [run_mission(size, seed) for seed in seeds]
    return [summarize(size, name, [one[name] for one in found]) for name in DECIDERS]


def run_mission(size: int, seed: int) -> dict[str, dict[str, Any]]:
    """Return the results of each strategy on one mission."""
    calm, after = Mission(size, size, seed), Mission(size, size, seed, FAILED_PERCENT)
    (least, by), (least_after, _) = solve_assignment(calm), solve_assignment(after)
    cbba_run, alive = run_cbba(calm), set(after.alive)
    found = {}
    for name in DECIDERS:
        now, then = make_outcome(name, calm, cbba_run), make_outcome(name, after)
        kept = [task for task, agent in now.owners.items() if agent in alive]
        is_greedy = name == "cbba" and size <= MAX_FULL_BIDDERS  # in larger missions CBBA does not use every bid
        found[name] = {
            "ratio": compute_cost(calm, now.owners) / least,
            "ratio_failed": compute_cost(after, then.owners) / least_after,
            "moved": sum(then.owners.get(task) != now.owners[task] for task in kept) / max(1, len(kept)),
            "messages": now.messages,
            "kB": now.kB,
            "rounds": now.rounds,
            "cpu_ms": now.cpu_ms,
            "by": by,
            "two_owners": sum(len(o) > 1 for o in cbba_run.owners.values()) if name in EXCHANGING else 0,
            "unlike_greedy": len(make_collected_outcome(name, calm).owners.items() ^ now.owners.items())
            if is_greedy
            else 0,
        }
    return found


def summarize(size: int, name: str, found: list[dict[str, Any]]) -> dict[str, Any]:
    """Summarise one strategy on the missions of one size: means, and the median of the processor time."""
    means = ("ratio", "ratio_failed", "moved", "messages", "kB", "rounds")
    row: dict[str, Any] = {"agents": size, "missions": len(found), "strategy": name, "by": found[0]["by"]}
    row |= {key: fmean(one[key] for one in found) for key in means}
    row |= {key: sum(one[key] for one in found) for key in ("two_owners", "unlike_greedy")}
    row["cpu_ms"] = median(one["cpu_ms"] for one in found)
    # The agents of CBBA compute in parallel, even while messages are in transit.
    row["agree_s"] = row["rounds"] * ROUND_S + (0.0 if name in EXCHANGING else row["cpu_ms"] / 1000.0)
    return row


def compute_cost(mission: Mission, owners: Owners) -> float:
    """Return the sum of all routes; a task without an agent costs as much as the longest route."""
    longest = max(max(row.values()) for row in mission.costs.values())
    return float(sum(mission.costs[owners[t]][t] if t in owners else longest for t in mission.task_positions))


def compare_routes(seeds: int, seconds: float) -> dict[str, Any]:
    """Compare the routes of the sequential auction with the shortest routes found in ``seconds`` per task."""
    ratios, worst, by = {}, {}, ""
    for agents, tasks in ROUTE_SIZES:
        found = []
        for seed in range(1, seeds + 1):
            mission = Mission(agents, tasks, seed, spare=1)
            ways = plan_routes(mission.make_reports(mission.alive, tasks), mission.items) or {}
            best, by = search_routes(mission, ways, seconds * tasks)
            found.append(measure_routes(mission, ways) / best)
        ratios[f"{agents} x {tasks}"] = fmean(found)
        worst[f"{agents} x {tasks}"] = max(found)
    return {"ratios": ratios, "worst": worst, "by": by}


def check_targets(rows: list[dict[str, Any]], ways: dict[str, Any], seeds: range) -> list[dict[str, Any]]:
    """Return the targets, and whether they are met."""
    hundred = {row["strategy"]: row for row in rows if row["agents"] == 100}
    found = []

    def demand(what: str, value: float, most: float) -> None:
        found.append({"what": what, "is": value, "most": most, "is_met": value <= most + 1e-9})

    if hundred:
        demand("cost of group_optimal, 100 x 100", hundred["group_optimal"]["ratio"], 1.0)
        demand("  with 20 bids of each", hundred[LIMITED_OPTIMUM]["ratio"], 1.01)
        demand("cost of cbba + exchange, 100 x 100", hundred["cbba + exchange"]["ratio"], 1.05)
        demand("  by meetings of two", hundred[MEETINGS]["ratio"], 1.05)
        demand("messages of an agent, cbba, 100 x 100, four neighbours", hundred["cbba"]["messages"], 70.0)
        demand("  kB of an agent", hundred["cbba"]["kB"], 50.0)
        demand("  s of processor of the whole team", hundred["cbba"]["cpu_ms"] / 1000.0, 1.0)
        demand("  tasks with another owner than the greedy one", float(hundred["cbba"]["unlike_greedy"]), 0.0)
    demand("tasks with two owners, cbba, all sizes", float(sum(row["two_owners"] for row in rows)), 0.0)
    demand("ways of sequential, mean of six sets", fmean(ways["ratios"].values()), 1.15)
    for size, most in ((100, 10.0), (300, 300.0)):
        demand(f"Hungarian without a library, {size} x {size}, ms", measure_solver_ms(size, seeds), most)
    return found


def measure_solver_ms(size: int, seeds: range) -> float:
    """Return the milliseconds of processor time of one exact assignment, the median of several."""
    took = []
    for seed in seeds:
        mission = Mission(size, size, seed)
        costs = [list(row.values()) for row in mission.costs.values()]
        for _ in range(5 if size <= 100 else 1):
            started_at = time.process_time()
            hungarian.solve(costs)
            took.append((time.process_time() - started_at) * 1000.0)
    return median(took)


def format_row(row: dict[str, Any]) -> str:
    """Return one row of the table."""
    assert math.isfinite(row["ratio"])
    return (
        f"{row['agents']:6d} {row['missions']:8d} {row['strategy']:24s} {row['ratio']:6.3f} {row['ratio_failed']:7.3f}"
        f" {row['moved']:6.2f} {row['messages']:8.1f} {row['kB']:6.2f} {row['rounds']:6.0f} {row['agree_s']:7.2f}"
        f" {row['cpu_ms']:8.1f}"
    )


if __name__ == "__main__":
    sys.exit(main())
