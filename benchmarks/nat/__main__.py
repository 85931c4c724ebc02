"""``make live-nat``: measure the path and the time to connect for real nodes behind every pair of NATs.

Needs Linux and either root or user namespaces; everything runs in separate network namespaces. Prints a table, and
writes every trial as JSON and the matrix as SVG. The exit code is 1 if a requirement is not met, 2 if the benchmark
cannot run.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import signal
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from benchmarks.nat.outcome import PLAIN, Outcome, check_requirements
from benchmarks.nat.report import draw_svg, format_table, update_document
from sim.demo.preparation import print_line
from sim.demo.trials import parse_count
from sim.namespaces.internet import Internet
from sim.namespaces.namespace import find_unavailable_reason

DOCUMENT = Path("docs/internals/nat.md")
PICTURE = "images/nat.svg"


async def run(count: int, lossy: int, seed: int) -> list[Outcome]:
    """Run the whole matrix; also clean up on SIGTERM."""
    from benchmarks.nat.hosts import Hosts
    from benchmarks.nat.matrix import Matrix, list_sites

    task = asyncio.current_task()
    assert task is not None
    for number in (signal.SIGTERM, signal.SIGINT):
        asyncio.get_running_loop().add_signal_handler(number, task.cancel)
    with tempfile.TemporaryDirectory(prefix="nat-") as folder, Internet(list_sites(), seed) as net:
        print_line(f"{len(net.hosts)} hosts on {len(net.sites)} sites")
        async with Hosts(net, net.hosts, Path(folder)) as hosts:
            matrix = Matrix(net, hosts, seed, print_line)
            await matrix.run(count, lossy)
            return matrix.outcomes


def main(arguments: Sequence[str] = tuple(sys.argv[1:])) -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.nat", description="Connect real nodes behind NATs.")
    parser.add_argument("--count", type=parse_count, default=5, help="rounds of every pair (%(default)s)")
    parser.add_argument("--lossy", type=parse_count, default=4, help="rounds with 30 %% loss (%(default)s)")
    parser.add_argument("--seed", type=int, default=1, help="seed of losses and keys (%(default)s)")
    parser.add_argument("--out", type=Path, default=Path("build"), help="folder for the JSON and the picture")
    parser.add_argument("--docs", action="store_true", help=f"also write table and picture to {DOCUMENT}")
    args = parser.parse_args(list(arguments))
    why = find_unavailable_reason()
    if why:
        sys.stderr.write(f"!!!\n!!! live-nat CANNOT RUN HERE: {why}\n!!!\n")
        return 2
    try:
        args.out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        parser.error(f"--out {args.out} cannot be created ({error.strerror}); choose another folder")
    started_at = time.monotonic()
    try:
        outcomes = asyncio.run(run(args.count, args.lossy, args.seed))
    except asyncio.CancelledError:
        sys.stderr.write("live-nat: ended early; its processes and namespaces have been removed\n")
        return 130
    kept = check_requirements(outcomes)
    file = args.out / "live-nat"
    trials = {"promises": [asdict(one) for one in kept], "trials": [asdict(one) for one in outcomes]}
    file.with_suffix(".json").write_text(json.dumps(trials, indent=1) + "\n", encoding="utf-8")
    picture = draw_svg([one for one in outcomes if one.part == PLAIN], "Seconds until the first answer")
    file.with_suffix(".svg").write_text(picture, encoding="utf-8")
    print_line(f"\n{format_table(outcomes)}\n{file}.json, .svg; {time.monotonic() - started_at:.0f} s")
    if args.docs:
        DOCUMENT.write_text(update_document(DOCUMENT.read_text(encoding="utf-8"), outcomes), encoding="utf-8")
        (DOCUMENT.parent / PICTURE).write_text(picture, encoding="utf-8")
    return 0 if all(one.is_kept for one in kept) else 1


if __name__ == "__main__":
    sys.exit(main())
