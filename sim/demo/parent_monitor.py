"""Run a program that ends when its parent ends, also if the parent is killed.

``python -m sim.demo.parent_monitor FILE|-m MODULE [ARGUMENTS]`` runs the program in this process, so the process id
stays the same.  The parent holds the other end of standard input and never writes; end of file means that the parent
has ended. The kernel closes the pipe however the parent ends, which a signal handler cannot guarantee.
"""

from __future__ import annotations

import os
import runpy
import signal
import sys
import threading
import time

GRACE_S = 3.0
"""Seconds between SIGTERM and the forced end."""


def _wait_for_parent(descriptor: int) -> None:
    while os.read(descriptor, 4096):
        pass
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(GRACE_S)
    os._exit(1)


def main() -> None:
    """Run the program of the command line and watch standard input."""
    if len(sys.argv) < 2 or sys.argv[1:] == ["-m"]:
        raise SystemExit("usage: python -m sim.demo.parent_monitor FILE|-m MODULE [ARGUMENTS]")
    parent_pipe = os.dup(0)
    os.set_inheritable(parent_pipe, False)
    threading.Thread(target=_wait_for_parent, args=(parent_pipe,), name="leash", daemon=True).start()
    if sys.argv[1] == "-m":
        module = sys.argv[2]
        sys.argv = sys.argv[2:]
        runpy.run_module(module, run_name="__main__", alter_sys=True)
    else:
        sys.argv = sys.argv[1:]
        runpy.run_path(sys.argv[0], run_name="__main__")


if __name__ == "__main__":
    main()
