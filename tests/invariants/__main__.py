"""Runs schedules from the command line; see the package."""

from __future__ import annotations

import argparse
import os
import sys
import time

from tests.invariants.bug import BUGS, FINDERS
from tests.invariants.run import LEASES, WORKLOADS, run_all

BOUND = 400
"""Schedules within which each bug must show, unless fewer are asked for."""


def main() -> int:
    """Run what the arguments say; 1 where a schedule failed (or, with bugs, where one of them did not show)."""
    parser = argparse.ArgumentParser(prog="python -m tests.invariants", description=__doc__)
    parser.add_argument("--schedules", type=int, help="how many to run (default 200; of each bug at most 400)")
    parser.add_argument("--seed", type=int, default=1, help="the seed of the first; the others follow (default 1)")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="processes (default: one for each core)")
    names = ", ".join((*WORKLOADS, LEASES))
    parser.add_argument("--only", default="", help=f"workloads in all of them, with commas: {names}")
    parser.add_argument("--bug", choices=sorted(BUGS), help="run with a bug put in, until it shows")
    parser.add_argument("--bugs", action="store_true", help="run with each bug in turn, and say when it showed")
    wanted = parser.parse_args()
    only = tuple(name for name in wanted.only.split(",") if name)
    if unknown := [name for name in only if name not in (*WORKLOADS, LEASES)]:
        parser.error(f"--only: no workload {unknown[0]}; there are {names}")
    began, failed = time.monotonic(), 0
    count = wanted.schedules or (BOUND if wanted.bugs or wanted.bug else 200)
    seeds = range(wanted.seed, wanted.seed + count)
    if wanted.bugs:
        return show_bugs(seeds, wanted.jobs)
    if wanted.bug:
        only = only or FINDERS.get(wanted.bug, ("records",))
    for outcome in run_all(seeds, wanted.jobs, only, wanted.bug):
        if outcome.found:
            failed += 1
            extra = (f" --only {wanted.only}" if only else "") + (f" --bug {wanted.bug!r}" if wanted.bug else "")
            say(f"FAILED  python -m tests.invariants --schedules 1 --seed {outcome.seed}{extra}")
            say(f"        {outcome.title}")
            for line in outcome.found[:6]:
                say(f"        {line}")
            if wanted.bug:
                break
    say(f"{failed} of {count} schedules failed, {time.monotonic() - began:.0f} s")
    return int(bool(failed) != bool(wanted.bug))


def show_bugs(seeds: range, jobs: int) -> int:
    """Print of each bug which schedule showed it, how many it took, and what was broken."""
    hidden = 0
    say(f"{'bug':48s} {'workloads':16s} {'seed':>5s}  {'needed':>6s}  shows as")
    for bug in BUGS:
        only = FINDERS.get(bug, ("records",))
        for number, outcome in enumerate(run_all(seeds, jobs, only, bug), start=1):
            if outcome.found:
                broken = sorted({line.partition(":")[0] for line in outcome.found})
                say(f"{bug:48s} {'+'.join(only):16s} {outcome.seed:5d}  {number:6d}  {', '.join(broken)}")
                break
        else:
            hidden += 1
            say(f"{bug:48s} {'+'.join(only):16s} {'-':>5s}  {'>' + str(len(seeds)):>6s}  nothing")
    say(f"{len(BUGS) - hidden} of {len(BUGS)} bugs were found")
    return int(hidden > 0)


def say(line: str) -> None:
    """Print a line at once."""
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())
