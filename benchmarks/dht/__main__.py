"""Run ``python -m benchmarks.dht [--nodes 8,32] [--seconds 5] [--peers ...] [--out FILE] [--plot FILE]``."""

from __future__ import annotations

import argparse
import asyncio
import json
import platform
import signal
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from benchmarks.dht.library import LIBRARIES, Library, select_libraries
from benchmarks.dht.loss import MIN_NODES, measure_losses
from benchmarks.dht.optional_features import measure_long_values, measure_watches
from benchmarks.dht.plot import draw_svg
from benchmarks.dht.report import format_table
from benchmarks.dht.space import measure_space
from benchmarks.dht.team import Team
from benchmarks.dht.workload import Plan, Result, Workload
from benchmarks.remote import OrderFailed

PARTS = ("steady", "killed", "silent")
KEYS = 200
EXIT_INTERRUPTED = 130


async def run_part(workload: Workload, part: str) -> None:
    """Run one part of the comparison with a separate team."""
    if part != "steady":
        await measure_losses(workload, is_silent=part == "silent")
    elif await workload.run_healthy():
        for verb in (measure_watches, measure_long_values, measure_space):
            await verb(workload)


async def measure_library(entry: Library, size: int, plan: Plan, parts: Sequence[str], result: Result) -> None:
    """Measure one library at one size; ``result`` has the figures obtained, also after an error."""
    task = asyncio.current_task()
    assert task is not None
    asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, task.cancel)
    for part in parts:
        if part != "steady" and size < MIN_NODES:
            continue
        figures = result if part == "steady" else result.setdefault(part, {})
        with tempfile.TemporaryDirectory() as folder:
            try:
                async with Team(entry, size, folder) as team:
                    await run_part(Workload(team, plan, figures), part)
            except OrderFailed as error:
                figures.setdefault("trouble", {})["team"] = str(error)


def main(arguments: Sequence[str]) -> int:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.dht", description="Compare DHT libraries.")
    parser.add_argument("--nodes", default="8,32", help="sizes of the network, each node a process (default 8,32)")
    parser.add_argument("--seconds", type=float, default=5.0, help="duration of each load (default 5)")
    parser.add_argument(
        "--peers",
        default=",".join(LIBRARIES),
        help="libraries, comma-separated (default %(default)s); opendht selects both of its variants",
    )
    parser.add_argument(
        "--parts",
        default=",".join(PARTS),
        help=f"parts, comma-separated (default %(default)s); failures need {MIN_NODES} nodes",
    )
    parser.add_argument("--seed", type=int, default=1, help="seed of the choice of nodes (default 1)")
    parser.add_argument("--profile", default="", help="prefix of files for profiles of two nodes under load")
    parser.add_argument("--out", help="write all figures to this file, as JSON")
    parser.add_argument("--plot", help="draw the main figures to this file, as SVG")
    args = parser.parse_args(arguments)
    try:
        entries = select_libraries(args.peers)
        sizes = [int(size) for size in args.nodes.split(",")]
    except ValueError as error:
        parser.error(str(error))
    parts = args.parts.split(",")
    if min(sizes) < 3 or args.seconds <= 0 or not set(parts) <= set(PARTS):
        parser.error("--nodes must be 3 or more, --seconds above 0, --parts some of " + ", ".join(PARTS))
    keys = min(KEYS, max(10, int(KEYS * args.seconds)))
    plan = Plan(keys, args.seconds, seed=args.seed, profile=args.profile)
    for entry in entries:
        if not entry.is_installed:
            sys.stderr.write(f"{entry.name}: skipped, the package {entry.package} is missing: pip install '.[bench]'\n")
    results: dict[str, dict[str, Result]] = {}
    ended = 0
    try:
        for size in sizes:
            for entry in [entry for entry in entries if entry.is_installed]:
                sys.stderr.write(f"{entry.name}, {size} nodes\n")
                result = results.setdefault(str(size), {}).setdefault(entry.name, {})
                asyncio.run(measure_library(entry, size, plan, parts, result))
    except (KeyboardInterrupt, asyncio.CancelledError):
        sys.stderr.write("ended early; what was measured until now:\n")
        ended = EXIT_INTERRUPTED
    sys.stdout.write(format_table(results))
    if args.out:
        about = {"python": platform.python_version(), "machine": platform.machine(), **vars(plan)}
        behind = {e.name: {"behind": e.storage, "promise": e.guarantee, "largest": e.largest} for e in entries}
        text = json.dumps({"about": about, "behind": behind, "results": results}, indent=1)
        Path(args.out).write_text(text + "\n", encoding="utf-8")
    if args.plot:
        Path(args.plot).write_text(draw_svg(results), encoding="utf-8")
    return ended


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
