"""``make bench-takeover``: measure the time without an acting robot after a failure, for each cause.

``--count`` trials of each cause run in virtual time with the share ``--loss`` of lost datagrams, and ``--real`` trials
with processes, each node in a separate network namespace. Prints a table, and writes every trial as JSON and the
histograms as SVG.
"""

from __future__ import annotations

import argparse
import json
import math
import multiprocessing
import os
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import suppress
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

from twisted.internet.defer import Deferred
from twisted.internet.task import react

from benchmarks.takeover.cause import VIRTUAL_ONLY, Cause, Trial
from benchmarks.takeover.lan import run_in_network
from benchmarks.takeover.report import draw_svg, format_table
from benchmarks.takeover.virtual import run_trial
from sim.demo.trials import parse_count

INSIDE = "--inside"


def run_virtual(causes: Sequence[Cause], count: int, seed: int, loss: float, jobs: int) -> list[Trial]:
    """Run ``count`` trials of each cause in virtual time, ``jobs`` at a time."""
    wanted = [(cause, seed + number) for cause in causes for number in range(count)]
    with ProcessPoolExecutor(max(1, jobs), multiprocessing.get_context("spawn")) as pool:
        done = pool.map(partial(run_trial, loss=loss), *zip(*wanted, strict=True)) if wanted else ()
        return [_print_trial(one) for one in done]


def run_real(causes: Sequence[Cause], count: int, seed: int) -> list[Trial]:
    """Run ``count`` trials of each cause with processes; call it inside of ``lan.run_in_network``."""
    from benchmarks.takeover.real import run_trial as real_trial

    trials = []

    async def run(reactor: Any) -> None:
        for cause in (cause for cause in causes if cause not in VIRTUAL_ONLY):
            for number in range(count):
                trials.append(_print_trial(await real_trial(reactor, cause, seed + number)))

    with suppress(SystemExit):  # ``react`` ends with this exception; errors are already printed
        react(lambda reactor: Deferred.fromCoroutine(run(reactor)))
    return trials


def _print_trial(one: Trial) -> Trial:
    took = "never" if one.takeover is None else f"{one.takeover:.2f} s"
    word = "ok  " if one.has_passed else "FAIL"
    sys.stdout.write(
        f"{word} {one.cause} seed {one.seed}: {one.lost or 'nobody'} lost, {one.by or 'nobody'} done, {took}\n"
    )
    sys.stdout.flush()
    return one


def parse_share(word: str) -> float:
    """Parse a number from 0 to 1."""
    try:
        number = float(word)
    except ValueError:
        number = math.nan
    if not 0.0 <= number <= 1.0:
        raise argparse.ArgumentTypeError(f"must be a share from 0 to 1, is {word!r}")
    return number


def main(arguments: Sequence[str] = tuple(sys.argv[1:])) -> int:
    """Run the command line; return 0 if every trial held."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.takeover", description="Measure takeovers, by cause.")
    parser.add_argument(
        "--count", type=parse_count, default=200, help="trials of each cause in virtual time (%(default)s)"
    )
    parser.add_argument(
        "--real", type=parse_count, default=0, help="trials of each cause with real processes (%(default)s)"
    )
    parser.add_argument("--seed", type=int, default=1, help="the first seed")
    parser.add_argument(
        "--loss", type=parse_share, default=0.1, help="share of lost datagrams in virtual time (%(default)s)"
    )
    parser.add_argument(
        "--cause", choices=[c.name.lower() for c in Cause], action="append", help="only this cause; repeatable"
    )
    parser.add_argument("--jobs", type=parse_count, default=os.cpu_count() or 1, help="trials at the same time")
    parser.add_argument("--out", type=Path, default=Path("build"), help="folder for the JSON and the pictures")
    parser.add_argument(INSIDE, action="store_true", help=argparse.SUPPRESS)
    args = parser.parse_args(list(arguments))
    causes = [cause for cause in Cause if not args.cause or cause.name.lower() in args.cause]
    if not args.count and not args.real:
        parser.error("--count and --real are both 0; there is nothing to do")
    try:
        args.out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        parser.error(f"--out {args.out} cannot be created ({error.strerror}); choose another folder")
    if args.inside:
        real_ones = run_real(causes, args.real, args.seed)
        return _write_report(real_ones, args.out, "real", f"real processes, {args.real} a cause")
    worst = 0
    if args.count:
        title = f"virtual time, {args.count} a cause, {args.loss:.0%} of the datagrams lost"
        worst = _write_report(
            run_virtual(causes, args.count, args.seed, args.loss, args.jobs), args.out, "virtual", title
        )
    if args.real:
        worst = max(worst, run_in_network(["-m", "benchmarks.takeover", INSIDE, *arguments]))
    return worst


def _write_report(trials: Sequence[Trial], folder: Path, name: str, title: str) -> int:
    file = folder / f"bench-takeover-{name}"
    file.with_suffix(".json").write_text(json.dumps([asdict(one) for one in trials], indent=1), encoding="utf-8")
    file.with_suffix(".svg").write_text(draw_svg(trials), encoding="utf-8")
    sys.stdout.write(f"\n{title}\n{format_table(trials)}\n{file}.json, .svg\n")
    return 0 if all(one.has_passed for one in trials) else 1


if __name__ == "__main__":
    sys.exit(main())
