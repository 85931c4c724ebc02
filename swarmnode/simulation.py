"""The ``sim`` command: simulate whole teams in one process in virtual time."""

from __future__ import annotations

import gc
import shutil
import signal
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import FrameType

from twisted.logger import globalLogBeginner

from middleware.errors import SwarmError
from sim.team.command import Environment, run
from sim.team.scale.command import run_scale

WRONG = 2
GC_THRESHOLDS = 200_000, 20, 20
"""Garbage collection thresholds.  With Python's defaults of 700, 10, 10 a large team spends its time in collections
that find nothing."""
Verb = Callable[[Sequence[str], Environment], int]
VERBS: Mapping[str, tuple[Verb, str]] = {
    "run": (run, "run a scenario with whole nodes, and print the verdict"),
    "scale": (run_scale, "measure teams of many sizes, and plot the results"),
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the verb in ``arguments``; returns its exit code."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    verb = words[0] if words else ""
    if verb not in VERBS:
        lines = "".join(f"  {name:9}{about}\n" for name, (_, about) in VERBS.items())
        example = "sim run --scenario steady --nodes 100 --seed 7"
        usage = f"usage: sim VERB [options]\n\n{lines}\nexample:\n  {example}\n\nSee sim VERB --help.\n"
        if verb in ("", "--help", "-h"):
            sys.stdout.write(usage)
            return 0
        sys.stderr.write(f"sim: no verb {verb!r}; verbs: {', '.join(VERBS)}; see sim --help\n")
        return WRONG
    signals: list[int] = []

    def end(number: int, frame: FrameType | None) -> None:
        """End the run with a report at the first signal, and immediately at the second signal."""
        if signals:
            raise KeyboardInterrupt
        signals.append(number)

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, end)
    world = Environment(
        *(sys.stdout, sys.stderr, time.monotonic, time.process_time),
        read=lambda path: Path(path).read_text(encoding="ascii"),
        columns=shutil.get_terminal_size().columns if sys.stderr.isatty() else 0,
        is_stopped=lambda: bool(signals),
        on_allocated=_reduce_garbage_collection,
    )
    # Without an observer Twisted buffers log events, which keep references to nodes that have ended.
    globalLogBeginner.beginLoggingTo([], discardBuffer=True, redirectStandardIO=False)
    _reduce_garbage_collection()
    try:
        return VERBS[verb][0](words[1:], world)
    except SwarmError as error:
        sys.stderr.write(f"sim {verb}: {error}\n")
        return WRONG
    except KeyboardInterrupt:
        sys.stderr.write(f"\nsim {verb}: interrupted, without a report\n")
        return 130


def _reduce_garbage_collection() -> None:
    """Collect garbage rarely, and never among the current objects, which exist until the process ends."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(*GC_THRESHOLDS)


if __name__ == "__main__":
    sys.exit(main())
