"""Run schedules from the command line; the docstring of the package explains the options."""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from middleware.errors import BadSetting
from sim.team import seed_log
from sim.team.shrinking import Reduction
from tests.invariants.bug import BUGS, FINDERS
from tests.invariants.run import ALONE, WORKLOADS, Least, Outcome, hunt_all, least, line, run_all

BOUND = 400
"""The number of schedules that must detect each bug, unless fewer are requested."""
STRETCH = 1000
"""The maximum number of seeds in one line of a seed log."""
MOST_SHRUNK = 3
"""The maximum number of failed schedules that are reduced."""
INTERRUPTED = 130

NAMES = (*WORKLOADS, *ALONE)


def main() -> int:
    """Run the command; return 1 if a schedule failed, or with ``--bugs`` if a bug was not detected."""
    parser = argparse.ArgumentParser(prog="python -m tests.invariants", description=__doc__)
    parser.add_argument("--schedules", type=int, help="number of schedules (default 200; at most 400 per bug)")
    parser.add_argument(
        "--seed", type=int, default=1, help="first seed; the next schedules use the next seeds (default 1)"
    )
    parser.add_argument(
        "--jobs", type=int, default=os.cpu_count() or 1, help="number of processes (default: one per core)"
    )
    parser.add_argument("--scheduler", default="", metavar="ADDRESS", help="run on the workers of this Dask scheduler")
    parser.add_argument("--only", default="", help=f"workloads to run, separated by commas: {', '.join(NAMES)}")
    parser.add_argument("--keep", help="numbers of the faults to inject, from 0, separated by commas, or none")
    parser.add_argument("--calm", action="store_true", help="without random loss, duplication, reordering and jitter")
    parser.add_argument("--seconds", type=float, help="end workloads and faults after this number of seconds")
    parser.add_argument(
        "--shrink", type=float, default=60.0, help="seconds for reducing a failed schedule (default 60)"
    )
    parser.add_argument("--log", default="", metavar="FILE", help="append the results to this seed log")
    parser.add_argument("--resume", action="store_true", help="skip the seeds in the seed log")
    parser.add_argument(
        "--bug", choices=sorted(BUGS), metavar="NAME", help="run with this seeded bug until it is detected"
    )
    parser.add_argument("--bugs", action="store_true", help="run with each seeded bug in turn; print what detected it")
    args = parser.parse_args()
    only = tuple(name for name in args.only.split(",") if name)
    if unknown := [name for name in only if name not in NAMES]:
        parser.error(f"--only: unknown workload {unknown[0]}; choose from {', '.join(NAMES)}")
    count = args.schedules or (BOUND if args.bugs or args.bug else 200)
    if count < 1 or args.jobs < 1:
        parser.error("--schedules, --jobs: must be at least 1")
    if args.seconds is not None and not args.seconds > 0.0:
        parser.error("--seconds: must be more than 0")
    if args.resume and not args.log:
        parser.error("--resume: no seed log is given; add --log FILE")
    if args.log and (args.bug or args.bugs):
        parser.error("--log: runs with a seeded bug cannot be logged; remove --log")
    if args.bug:
        only = only or FINDERS[args.bug]
    try:
        seeds = range(args.seed, args.seed + count)
        if args.bugs:
            return show_bugs(seeds, args.jobs, args.scheduler)
        trim = Reduction(numbers(args.keep), args.calm, only, args.seconds)
        return Session(args, trim).run(seeds)
    except (BadSetting, OSError, ValueError) as error:
        parser.error(str(error))
    except KeyboardInterrupt:
        say("interrupted")
        return INTERRUPTED


def numbers(told: str | None) -> tuple[int, ...] | None:
    """Return the numbers of the faults in ``--keep``."""
    if told in (None, "none"):
        return None if told is None else ()
    named = str(told).split(",")
    if not all(number.isdecimal() for number in named):
        raise ValueError(f"--keep: {told!r} is not a list of fault numbers; use numbers separated by commas, or none")
    return tuple(map(int, named))


class Session:
    """One call of the command: runs the schedules, prints failures, and writes the seed log."""

    def __init__(self, args: argparse.Namespace, trim: Reduction) -> None:
        self._args = args
        self._trim = trim
        self._began = time.monotonic()
        self._is_interrupted = False
        self._failed = self._ran = 0

    def run(self, seeds: range) -> int:
        """Run all seeds; return 1 if a schedule failed or, with a seeded bug, if none detected the bug."""
        args = self._args
        signal.signal(signal.SIGINT, self._interrupt)
        if not args.log:
            for _ in self._outcomes(seeds):
                if args.bug and self._failed:
                    break
        else:
            self._log(seeds)
        say(f"{self._failed} of {self._ran} schedules failed, {time.monotonic() - self._began:.0f} s")
        return int(bool(self._failed) != bool(args.bug))

    def _outcomes(self, seeds: Sequence[int]) -> Iterator[Outcome]:
        args = self._args
        for outcome in run_all(seeds, args.jobs, (), args.bug, self._trim, args.scheduler):
            self._ran += 1
            if outcome.found:
                self._failed += 1
                self._print_failure(outcome)
            yield outcome
            if self._is_interrupted:
                raise KeyboardInterrupt

    def _interrupt(self, *_: object) -> None:
        """End after the present schedule; an exception during a schedule would be caught as a failure of a Deferred."""
        self._is_interrupted = True
        signal.signal(signal.SIGINT, signal.default_int_handler)

    def _print_failure(self, outcome: Outcome) -> None:
        """Print the failure, and the command that replays its smallest variant."""
        say(f"FAILED  {line(outcome.seed, self._trim, self._args.bug)}")
        say(f"        {outcome.title}")
        for violation in outcome.found[:6]:
            say(f"        {violation}")
        if self._args.shrink > 0.0 and self._failed <= MOST_SHRUNK:
            until = time.monotonic() + self._args.shrink
            self._print_least(outcome, least(outcome, self._args.bug, until_then(until), self._trim))

    def _print_least(self, whole: Outcome, left: Least) -> None:
        say(f"LEAST   {line(whole.seed, left.trim, self._args.bug)}")
        kept = whole.faults if left.trim.keep is None else len(left.trim.keep)
        say(f"        {kept} of {whole.faults} faults remain after {left.runs} runs: {left.outcome.found[0]}")

    def _log(self, seeds: range) -> None:
        """Run the seeds in several groups; log each finished seed, even if the run is interrupted."""
        args, what = self._args, "+".join(self._trim.only)
        text = Path(args.log).read_text(encoding="utf-8") if os.path.exists(args.log) else ""
        logged = seed_log.parse_entries(text, args.log)
        left = seed_log.find_missing(seeds, logged, what) if args.resume else list(seeds)
        Path(args.log).open("ab").close()
        say(f"{len(left)} of {len(seeds)} schedules, from seed {left[0]}" if left else "all seeds are in the seed log")
        commit, outcomes = commit_of(Path(__file__).resolve().parents[2]), self._outcomes(left)
        for stretch in seed_log.split_ranges(left, STRETCH):
            started_at, failures, ran = time.monotonic(), [], 0
            try:
                for _ in stretch:
                    outcome = next(outcomes)
                    ran += 1
                    if outcome.found:
                        failures.append(outcome.seed)
            finally:
                if ran:
                    date = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())
                    seconds = round(time.monotonic() - started_at, 1)
                    entry = seed_log.SeedRun(date, commit, what, stretch[0], ran, tuple(failures), seconds)
                    seed_log.append_entry(args.log, entry)
                    say(f"{self._ran} of {len(left)} schedules, {self._failed} failed; up to seed {stretch[ran - 1]}")


def until_then(moment: float) -> Callable[[], bool]:
    """Return a function that tells whether ``moment`` has passed."""
    return lambda: time.monotonic() > moment


def commit_of(tree: Path) -> str:
    """Return the commit of the working tree, with + if it has changes; an empty string outside a repository."""
    asked = subprocess.run(
        ["git", "describe", "--always", "--dirty=+", "--exclude=*"], cwd=tree, capture_output=True, text=True
    )
    return asked.stdout.strip()


def show_bugs(seeds: range, jobs: int, scheduler: str) -> int:
    """Print, for each bug, the schedule that detected it, the number of schedules, and the violations."""
    hidden, started_at = 0, time.monotonic()
    say(f"{'bug':48s} {'workloads':16s} {'seed':>5s}  {'needed':>6s}  shows as")
    for bug, only, number, outcome in hunt_all(seeds, jobs, scheduler):
        if outcome is None:
            hidden += 1
            say(f"{bug:48s} {'+'.join(only):16s} {'-':>5s}  {'>' + str(number):>6s}  nothing")
        else:
            broken = sorted({violation.partition(":")[0] for violation in outcome.found})
            say(f"{bug:48s} {'+'.join(only):16s} {outcome.seed:5d}  {number:6d}  {', '.join(broken)}")
    say(f"{len(BUGS) - hidden} of {len(BUGS)} bugs were found, {time.monotonic() - started_at:.0f} s")
    return int(hidden > 0)


def say(text: str) -> None:
    """Write a line and flush it immediately."""
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())
