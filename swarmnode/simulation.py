"""Simulation: the ``sim`` command, whole teams in one process on one turned clock."""

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
from sim.team.scale.command import scale

WRONG = 2
SPARING = 200_000, 20, 20
"""Objects made between two looks for garbage, and how often older ones are looked at; of Python's own 700, 10, 10 a
large team makes one look after the other at what is none."""
Verb = Callable[[Sequence[str], Environment], int]
VERBS: Mapping[str, tuple[Verb, str]] = {
    "run": (run, "play a scenario with whole nodes, to its verdict"),
    "scale": (scale, "measure teams of many sizes, and draw the curves"),
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the verb that the command line names; returns its exit code."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    verb = words[0] if words else ""
    if verb not in VERBS:
        lines = "".join(f"  {name:9}{about}\n" for name, (_, about) in VERBS.items())
        usage = f"usage: sim VERB [options]\n\n{lines}\nsim VERB --help says more.\n"
        if verb in ("", "--help", "-h"):
            sys.stdout.write(usage)
            return 0
        sys.stderr.write(f"sim: no verb {verb!r}; there is {', '.join(VERBS)}; sim --help says more\n")
        return WRONG
    signals: list[int] = []

    def end(number: int, frame: FrameType | None) -> None:
        """After the first signal a run ends in good order, after the second at once."""
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
        grown=_spare_the_collector,
    )
    # Until somebody listens Twisted keeps what is logged, and so each life of each node that logged it.
    globalLogBeginner.beginLoggingTo([], discardBuffer=True, redirectStandardIO=False)
    _spare_the_collector()
    try:
        return VERBS[verb][0](words[1:], world)
    except SwarmError as error:
        sys.stderr.write(f"sim {verb}: {error}\n")
        return WRONG
    except KeyboardInterrupt:
        sys.stderr.write(f"\nsim {verb}: ended, without a report\n")
        return 130


def _spare_the_collector() -> None:
    """Look for garbage rarely, and never at what is there now, for this process ends with it."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(*SPARING)


if __name__ == "__main__":
    sys.exit(main())
