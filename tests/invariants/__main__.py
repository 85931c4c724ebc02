"""Runs schedules from the command line; see the package."""

from __future__ import annotations

import argparse
import sys
import time

from tests.invariants.bug import BUGS, seeded
from tests.invariants.records import Records
from tests.invariants.schedule import Schedule


def main() -> int:
    """Run what the arguments say; 1 where a schedule failed (or, with a bug, where none did)."""
    parser = argparse.ArgumentParser(prog="python -m tests.invariants", description=__doc__)
    parser.add_argument("--schedules", type=int, default=200, help="how many to run (default 200)")
    parser.add_argument("--seed", type=int, default=1, help="the seed of the first; the others follow (default 1)")
    parser.add_argument("--bug", choices=sorted(BUGS), help="run with a bug put in, until it shows")
    arguments = parser.parse_args()
    began, failed = time.monotonic(), 0
    for seed in range(arguments.seed, arguments.seed + arguments.schedules):
        with seeded(arguments.bug):
            schedule = Schedule(seed)
            found = schedule.run([Records(schedule)])
        if found:
            failed += 1
            say(f"FAILED  {schedule.line}" + (f" --bug {arguments.bug!r}" if arguments.bug else ""))
            say(f"        n={schedule.n} {schedule.weather} faults: {'; '.join(map(str, schedule.faults))}")
            for line in found[:6]:
                say(f"        {line}")
            if arguments.bug:
                break
    say(f"{failed} of {arguments.schedules} schedules failed, {time.monotonic() - began:.0f} s")
    return int(bool(failed) != bool(arguments.bug))


def say(line: str) -> None:
    """Print a line at once."""
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


sys.exit(main())
