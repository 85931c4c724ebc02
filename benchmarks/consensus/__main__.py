"""Runs the strategies over the missions from the command line; see the package.

Cost is compared with the exact optimum of the same bids.  Messages, rounds and time are those of CBBA among the agents
themselves, and of bids that are gathered at one place and answered otherwise.  Exit code 1 where a target is missed.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from pathlib import Path
from statistics import fmean, median
from typing import Any

from benchmarks.consensus.decider import DECIDERS, Owners
from benchmarks.consensus.mission import Mission
from benchmarks.consensus.oracle import least_star, least_way, travelled
from benchmarks.consensus.plot import drawn
from benchmarks.consensus.talk import ROUND_S, Talked, after_meetings, talked
from middleware.consensus import hungarian
from middleware.consensus.sequential import ways_of

SIZES = (3, 10, 30, 100, 300, 1000)
QUICK = (3, 10, 30, 100)
FAILED = 10
PATHS = ((3, 3), (3, 6), (10, 10), (10, 20), (50, 50), (50, 100))
MEETINGS = "cbba, then meetings"
TALKED = ("cbba", MEETINGS)
FEW = 40
"""Bids of each agent beyond a hundred agents, where all would be a million."""


def main() -> int:
    """Measure what the arguments say, print it, and write it."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.consensus", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="up to 100 agents and two seeds; ends within 20 s")
    parser.add_argument(
        "--sizes", default="", help=f"numbers of agents, with commas (default {','.join(map(str, SIZES))})"
    )
    parser.add_argument("--seeds", type=int, default=0, help="missions of each size (default 5, quick 2)")
    parser.add_argument("--out", type=Path, help="write everything as JSON")
    parser.add_argument("--plot", type=Path, help="draw the costs as SVG")
    wanted = parser.parse_args()
    sizes = [int(n) for n in wanted.sizes.split(",")] if wanted.sizes else list(QUICK if wanted.quick else SIZES)
    seeds = range(1, 1 + (wanted.seeds or (2 if wanted.quick else 5)))
    print(f"{'agents':>6s} {'strategy':24s} {'cost':>6s} {'failed':>7s} {'moved':>6s} {'messages':>8s} {'kB':>6s}"
          f" {'rounds':>6s} {'agree s':>7s} {'CPU ms':>8s}")  # fmt: skip
    rows = []
    for size in sizes:
        few = seeds if size <= 300 else seeds[:1]
        missions = [(Mission(size, size, seed), Mission(size, size, seed, FAILED)) for seed in few]
        least = [(least_star(calm), least_star(after)) for calm, after in missions]
        talks = [talked(calm) for calm, _ in missions]
        for name in DECIDERS:
            row = judged(name, missions, least, talks)
            rows.append(row)
            print(line(row), flush=True)
    ways = paths(1 if wanted.quick else 3, 0.5 if wanted.quick else 4.0)
    found = targets(rows, ways, seeds)
    print(f"\nWays through several tasks, sequential, against the best known ({ways['by']}):")
    for key, ratio in ways["ratios"].items():
        print(f"    {key:12s} {ratio:.3f}")
    print(f"\nTargets (optimum by {rows[0]['by']}):")
    for target in found:
        word = "yes" if target["is_met"] else "NO"
        print(f"    {word:3s}  {target['what']:58s} {target['is']:9.3f} (at most {target['most']:g})")
    if wanted.out:
        wanted.out.write_text(json.dumps({"rows": rows, "ways": ways, "targets": found}, indent=1), encoding="utf-8")
    if wanted.plot:
        wanted.plot.write_text(drawn(rows), encoding="utf-8")
    return int(not all(target["is_met"] for target in found))


def judged(name: str, missions: list[tuple[Mission, Mission]], least: list[Any], talks: list[Talked]) -> dict[str, Any]:
    """One strategy over the missions of one size."""
    ratios, failed, moved, cpu, meetings = [], [], [], [], []
    for (calm, after), (best, best_after) in zip(missions, least, strict=True):
        bids = calm.tasks if calm.agents <= 100 else FEW
        owners, took, met = timed(name, calm, bids)
        ratios.append(cost(calm, owners) / best[0])
        cpu.append(took)
        meetings.append(met)
        again = timed(name, after, bids)[0]
        failed.append(cost(after, again) / best_after[0])
        kept = [task for task, agent in owners.items() if agent in set(after.alive)]
        moved.append(sum(again.get(task) != owners[task] for task in kept) / max(1, len(kept)))
    is_talked = name in TALKED
    rounds = fmean(t.rounds for t in talks) + fmean(meetings) if is_talked else 2.0
    thinking = fmean(t.cpu_s for t in talks) * 1000.0 if is_talked else median(cpu)
    return {
        "agents": missions[0][0].agents,
        "strategy": name,
        "ratio": fmean(ratios),
        "ratio_failed": fmean(failed),
        "moved": fmean(moved),
        "messages": fmean(t.messages for t in talks) + fmean(meetings) if is_talked else 2.0,
        "kB": fmean(t.octets for t in talks) / 1000.0 + 0.03 * fmean(meetings) if is_talked else 0.24,
        "rounds": rounds,
        "agree_s": rounds * ROUND_S + (0.0 if is_talked else thinking / 1000.0),
        "cpu_ms": thinking,
        "by": least[0][0][1],
        "two_owners": sum(len(o) > 1 for t in talks for o in t.owners.values()) if is_talked else 0,
    }


def timed(name: str, mission: Mission, bids: int) -> tuple[Owners, float, float]:
    """Who has each task, the milliseconds of processor that took, and the messages of each agent in meetings.

    What nobody bid for is bid for by all who have not, and everything is decided again.
    """
    took, holes = 0.0, set[str]()
    while True:
        reports = mission.reports(mission.alive, bids, holes)
        began = time.process_time()
        owners = DECIDERS[name](mission, reports)
        took += (time.process_time() - began) * 1000.0
        more = set(mission.places) - set(owners)
        if more <= holes:
            break
        holes |= more
    if name != MEETINGS:
        return owners, took, 0.0
    owners, messages = after_meetings(mission, owners)
    return owners, took, messages


def cost(mission: Mission, owners: Owners) -> float:
    """The sum of all ways; a task that nobody has costs as much as the longest."""
    longest = max(max(row.values()) for row in mission.costs.values())
    return float(sum(mission.costs[owners[t]][t] if t in owners else longest for t in mission.places))


def paths(seeds: int, seconds: float) -> dict[str, Any]:
    """The ways of the sequential auction against the shortest that are known."""
    ratios, by = {}, ""
    for agents, tasks in PATHS:
        found = []
        for seed in range(1, seeds + 1):
            mission = Mission(agents, tasks, seed, spare=1)
            ways = ways_of(mission.reports(mission.alive, tasks), mission.items) or {}
            best, by = least_way(mission, ways, seconds)
            found.append(travelled(mission, ways) / best)
        ratios[f"{agents} x {tasks}"] = fmean(found)
    return {"ratios": ratios, "by": by}


def targets(rows: list[dict[str, Any]], ways: dict[str, Any], seeds: range) -> list[dict[str, Any]]:
    """What the project has promised, and whether it holds."""
    hundred = {row["strategy"]: row for row in rows if row["agents"] == 100}
    found = []

    def demand(what: str, value: float, most: float) -> None:
        found.append({"what": what, "is": value, "most": most, "is_met": value <= most + 1e-9})

    if hundred:
        demand("cost of group_optimal, 100 x 100", hundred["group_optimal"]["ratio"], 1.0)
        demand("  with 20 bids of each", hundred["group_optimal, 20 bids"]["ratio"], 1.01)
        demand("cost of cbba + exchange, 100 x 100", hundred["cbba + exchange"]["ratio"], 1.05)
        demand("  by meetings of two", hundred[MEETINGS]["ratio"], 1.05)
        demand("messages of an agent, cbba, 100 x 100, four neighbours", hundred["cbba"]["messages"], 70.0)
        demand("  kB of an agent", hundred["cbba"]["kB"], 50.0)
        demand("  s of processor of the whole team", hundred["cbba"]["cpu_ms"] / 1000.0, 1.0)
        demand("  tasks with two owners", float(hundred["cbba"]["two_owners"]), 0.0)
    demand("ways of sequential, mean of six sets", fmean(ways["ratios"].values()), 1.15)
    for size, most in ((100, 10.0), (300, 300.0)):
        demand(f"Hungarian without a library, {size} x {size}, ms", solving(size, seeds), most)
    return found


def solving(size: int, seeds: range) -> float:
    """The milliseconds of processor of one exact assignment, the middle of several."""
    took = []
    for seed in seeds:
        mission = Mission(size, size, seed)
        costs = [list(row.values()) for row in mission.costs.values()]
        for _ in range(5 if size <= 100 else 1):
            began = time.process_time()
            hungarian.assigned(costs, with_scipy=False)
            took.append((time.process_time() - began) * 1000.0)
    return median(took)


def line(row: dict[str, Any]) -> str:
    """One row of the table."""
    assert math.isfinite(row["ratio"])
    return (
        f"{row['agents']:6d} {row['strategy']:24s} {row['ratio']:6.3f} {row['ratio_failed']:7.3f} {row['moved']:6.2f}"
        f" {row['messages']:8.1f} {row['kB']:6.1f} {row['rounds']:6.0f} {row['agree_s']:7.2f} {row['cpu_ms']:8.1f}"
    )


if __name__ == "__main__":
    sys.exit(main())
